"""Calibration methods to compare with: simple or published ones."""
