"""Calibration: from recordings to simulator parameters with intervals, and to what the data cannot tell.

Methods are found by name in their registry and know robots only by what the core defines.
"""
