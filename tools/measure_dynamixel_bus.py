#!/usr/bin/env python3
"""Round trips on a Dynamixel bus: both servos' registers, requested at a fixed rate.

    python tools/measure_dynamixel_bus.py --seconds 120
    python tools/measure_dynamixel_bus.py --port /dev/ttyUSB0 --rates 50 200

A round trip is the time from writing the request to the last byte of both servos' answers. The driver does
one for each sample (Fast Sync Read of 72 bytes each). The time of these bytes on the wire is shown beside it.
Without --port two emulated servos answer, which take the wire's time, too. --absent addresses an absent
servo, to measure the cost of a dead one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from measuring import Rows, spread

from deal_hw.clock import MonotonicClock
from deal_hw.control.process.realtime import become_realtime
from deal_hw.drivers.cartpole.dynamixel.connect import parse_port
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.servo_bus.bus import Bus
from deal_hw.drivers.servo_bus.registers import BLOCK_ADDRESS, BLOCK_BYTES
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.errors import FrameError, TransportTimeoutError
from deal_hw.workflows.emulation.process import EmulatorProcess

QUESTION_BYTES = 16
"""Header 4, id, length 2, instruction, address 2, size 2, two ids, CRC 2."""
ABSENT_ID = 200


@dataclass(frozen=True, kw_only=True)
class MeasureBus:
    """Measure round trips on a Dynamixel bus."""

    port: str | None = None
    """The port, with settings as for `deal-hw`; by default two servos are emulated."""

    rates: tuple[float, ...] = (50.0, 200.0)
    """Requests a second."""

    seconds: float = 120.0
    """Length of each row [s]."""

    baud_rate: int = 1_000_000
    """Baud rate of the emulated servos."""

    absent: bool = False
    """Address an absent servo."""

    out: Path | None = None
    """Write the rows to this JSON file."""


def measure(
    bus: Bus, settings: DynamixelSettings, rate_hz: float, seconds: float, absent: bool
) -> dict[str, Any]:
    """Return one row: round trips [ms] at a rate."""
    clock = MonotonicClock()
    servos = (ABSENT_ID,) if absent else (settings.cart_id, settings.pole_id)
    trips, missed, due_ns = [], 0, clock.now_ns()
    count = round(rate_hz * seconds)
    for _ in range(count):
        due_ns += round(1e9 / rate_hz)
        clock.sleep_until_ns(due_ns)
        asked_ns = clock.now_ns()
        bus.ask(servos, BLOCK_ADDRESS, BLOCK_BYTES, fast=not absent)
        try:
            while bus.take(asked_ns + 10**9) is None:
                continue
        except (TransportTimeoutError, FrameError):
            missed += 1
        trips.append((clock.now_ns() - asked_ns) / 1e6)
    wire_bytes = QUESTION_BYTES + bus.answer_bytes(len(servos), BLOCK_BYTES, not absent)
    return {
        "rate_hz": rate_hz,
        "questions": count,
        "missed": missed,
        **spread(trips, "_ms"),
        "wire_ms": round(1e4 * wire_bytes / settings.baud_rate, 3),
    }


@contextlib.contextmanager
def some_port(config: MeasureBus) -> Iterator[str]:
    """Yield the given port, or that of emulated servos."""
    if config.port is not None:
        yield config.port
        return
    rate = str(config.baud_rate)
    with EmulatorProcess(
        "cartpole", "--transport", "dynamixel", "--nominal", "--profile", "sensor", "--servo-baud-rate", rate
    ) as emulator:
        yield f"{emulator.port}?baud_rate={rate}"


def main(config: MeasureBus) -> None:
    """Measure and print each row as it comes."""
    rows = Rows(__file__, config.out)
    with some_port(config) as port:
        path, settings = parse_port(port)
        become_realtime()
        with SerialTransport(path, settings.baud_rate) as transport:
            bus = Bus(transport, MonotonicClock(), settings.baud_rate, settings.answer_s)
            for rate_hz in config.rates:
                rows.add(measure(bus, settings, rate_hz, config.seconds, config.absent))


if __name__ == "__main__":
    main(tyro.cli(MeasureBus, description=__doc__))
