"""Robots of users: a robot.yaml beside an MJCF, and both inside a dataset."""
