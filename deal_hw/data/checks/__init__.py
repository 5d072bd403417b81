"""Checks of recordings of unknown origin, before any long work: clock, units, joints, commands, slips."""
