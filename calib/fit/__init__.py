"""Fits that follow derivatives, and the uncertainty of what they find."""
