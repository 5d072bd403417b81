"""Robots with legs: simulated step by step, and what feet that stand say of the base."""
