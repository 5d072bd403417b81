"""The user's own MJCF: a description of its robot, and the calibrated model as a change of its text."""
