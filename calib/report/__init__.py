"""The report of a calibration: one HTML page that needs nothing beside it."""
