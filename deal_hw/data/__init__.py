"""Recordings: written as MCAP while they happen, repaired after a kill, checked, and read back as arrays."""
