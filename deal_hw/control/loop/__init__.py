"""The control loop: its cycle, timing and report."""
