"""Calibration: simulator parameters from recordings, their intervals, and what the data do not show."""
