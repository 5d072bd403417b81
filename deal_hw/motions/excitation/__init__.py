"""Motions that excite a robot for calibration, within its limits."""
