"""Feetech's STS and SMS servos: packets, registers, the bus, and emulated servos."""
