"""Opens a bus of servos for questions."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Final

from deal_hw.clock import MonotonicClock
from deal_hw.drivers.servo_arm.families import FAMILIES
from deal_hw.drivers.servo_arm.survey import Survey
from deal_hw.drivers.transports.serial_transport import SerialTransport

ANSWER_S: Final = 0.02
"""Longest delay of an answer beside its bytes [s]: an FTDI adapter as it is delivered waits for 16 ms."""


@contextlib.contextmanager
def open_bus(bus: str, port: str, baud_rate: int, answer_s: float = ANSWER_S) -> Iterator[Survey]:
    """Open a port, and ask the servos on it.

    Args:
        bus: "feetech" or "dynamixel".
        port: Path of the serial port.
        baud_rate: Rate of the servos [bit/s].
        answer_s: Longest delay of an answer beside its bytes [s].

    Raises:
        TransportError: The port cannot be opened.
    """
    clock, family = MonotonicClock(), FAMILIES[bus]()
    transport = SerialTransport(port, baud_rate, clock)
    transport.open()
    try:
        yield Survey(family.bus(transport, clock, baud_rate, answer_s), family, clock, port)
    finally:
        transport.close()
