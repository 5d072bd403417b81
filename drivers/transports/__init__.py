"""Paths for bytes and messages to a robot, one module each, independent of the protocol."""
