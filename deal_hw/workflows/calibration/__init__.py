"""Calibration: recordings read and checked, the search run, the result judged and written."""
