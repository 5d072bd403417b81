"""Unitree G1: driver, descriptions, emulator."""
