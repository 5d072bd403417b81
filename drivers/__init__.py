"""Drivers of robots, their emulators, and the transports that carry their bytes.

:mod:`deal_hw.robots` has the table of them and makes a robot from its name.
"""
