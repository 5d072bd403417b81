"""The calibration problem: recordings, noise, smoothed states, windows."""
