"""Fits that follow derivatives."""
