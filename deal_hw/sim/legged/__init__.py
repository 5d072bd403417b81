"""Legged robots: simulation step by step, and estimates of the base from standing feet."""
