"""Unitree B2: its description and what its driver and emulator have beside the Go2's."""
