"""Calibration methods to compare with: simple, published or deliberately ignorant ones."""
