"""Motions of a run, before the safety filter: behaviours, excitation, posture, and how well they went."""
