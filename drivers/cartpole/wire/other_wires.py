"""Finds out what answers at a serial port that was opened as another wire: for ``deal-hw doctor``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from deal_hw.clock import Clock
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.link import SerialLink
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.drivers.transports.slcan_transport import TTY_BAUD_RATE
from deal_hw.errors import DealHwError, TransportTimeoutError
from deal_hw.findings import Finding, Severity
from deal_hw.transport import Message, Transport

_LISTEN_S: Final = 0.3
"""How long an answer may take [s]."""
_SLCAN_VERSION: Final = re.compile(rb"V[0-9A-Za-z]{4}\r")
_SERVO_RATES: Final = (1_000_000, 57_600)
"""Rates of servos that were set up for deal-hw, and of new ones."""
MakeTransport = Callable[[str, int, Clock], Transport]


class _Wire(NamedTuple):
    """What answered, and the transports of deal-hw that speak with it, with the port for each."""

    name: str
    transports: tuple[str, ...]
    port: str


def name_other_wire(
    port: str, transport: str, clock: Clock, make: MakeTransport = SerialTransport
) -> Iterator[Finding]:
    """Yield a finding if something of another wire answers at a port; motors are not switched on.

    An adapter is asked for its version, servos are pinged, a cart-pole is greeted.

    Args:
        port: As given by the user for ``transport``.
        transport: Its name, such as "serial".
        clock: For the waiting.
        make: Makes a transport of a path, a baud rate and a clock.
    """
    path = port.partition("?")[0].removeprefix("slcan:")
    if "/" not in path:
        return
    try:
        found = _find(path, clock, make)
    except DealHwError:
        return
    if found is None or transport in found.transports:
        return
    ways = " or ".join(f"--transport {name} --port {found.port}" for name in found.transports)
    yield Finding(
        "link",
        Severity.FAIL,
        f"{path} answers as {found.name}, so --transport {transport} is the wrong wire for it",
        f"use {ways}",
    )


def _find(path: str, clock: Clock, make: MakeTransport) -> _Wire | None:
    with make(path, TTY_BAUD_RATE, clock) as serial:
        if _SLCAN_VERSION.search(_answer(serial, clock, b"\r\rV\r")):
            return _Wire("a serial CAN adapter (slcan)", ("can", "odrive"), f"slcan:{path}")
        link = SerialLink()
        hello = link.resync + link.encode(protocol.Hello(1))
        if any(isinstance(m, protocol.Info) for m in link.decode(_answer(serial, clock, hello))):
            return _Wire("a device with deal-hw's serial protocol", ("serial",), path)
    # The SDK of the servos may be absent; then they are not asked.
    from deal_hw.drivers.servo_bus.bus import Bus

    for rate in _SERVO_RATES:
        with make(path, rate, clock) as serial:
            if servos := sorted(Bus(serial, clock, rate, _LISTEN_S).broadcast_ping(_LISTEN_S)):
                ids = ", ".join(map(str, servos))
                return _Wire(f"Dynamixel servos (id {ids} at {rate} baud)", ("dynamixel",), path)
    return None


def _answer(serial: Transport, clock: Clock, request: bytes) -> bytes:
    """Return what comes within the time for an answer."""
    serial.send(Message("", request, clock.now_ns()))
    end_ns, out = clock.now_ns() + round(_LISTEN_S * 1e9), b""
    while (left_ns := end_ns - clock.now_ns()) > 0:
        try:
            out += serial.receive(left_ns / 1e9).payload
        except TransportTimeoutError:
            break
    return out
