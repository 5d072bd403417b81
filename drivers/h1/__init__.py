"""Unitree H1 on a crane: description, driver, doctor and emulator; its messages are unitree_go's."""
