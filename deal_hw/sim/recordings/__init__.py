"""Recordings beside simulation: on the device's time grid, in windows, with the state of a floating base."""
