"""The calibration problem: recordings, noise, smoothed states, windows; and what all searches of it share."""
