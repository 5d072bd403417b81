"""Emulated robots: on a wire in their own process, and in virtual time."""
