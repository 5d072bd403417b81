"""The whole calibration: its stages, its strategies, and the table of methods."""
