"""A robot.yaml of one's own: how it comes into being, and how it is compared with MJCF and servos."""
