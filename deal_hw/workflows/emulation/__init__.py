"""Emulated robots: on a wire in a process of their own, and in virtual time."""
