"""Paths for bytes and messages to a robot, one module each; DDS needs the Go2's topics and their types."""
