"""Calibration: read and check the recordings, search, judge and write the result."""
