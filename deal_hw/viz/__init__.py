"""Rerun: real, nominal and calibrated motion on one screen. The only package that imports rerun."""
