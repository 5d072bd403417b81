"""Paths for bytes and messages to a robot, one module each; they know no protocol."""
