"""Waits for the states of exactly one Go2, or finds the reason why none arrive."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Final

from deal_hw.clock import Clock
from deal_hw.drivers.go2.state_stream import StateStream
from deal_hw.drivers.transports import topics
from deal_hw.errors import TransportTimeoutError, WrongDeviceError
from deal_hw.transport import TopicTransport

CONNECT_TIMEOUT_S: Final = 5.0
_FIRST_STATES: Final = 20
"""Number of valid states with a running clock that identify a Go2."""
_TOO_MANY: Final = 20
"""Number of messages without a valid state after which the device is no Go2."""


def await_robot(
    transport: TopicTransport, clock: Clock, stream: StateStream, pump: Callable[[float], None]
) -> None:
    """Wait for states of one Go2 whose clock runs.

    Args:
        transport: Topics of the robot; open.
        clock: For waiting.
        stream: Checks the states; not used before.
        pump: Receives one message, waiting at most so long [s], and gives states to the stream; raises
            TransportTimeoutError if none arrives.

    Raises:
        TransportTimeoutError: No states come, or their clock stands still.
        WrongDeviceError: It is another robot, or there are two.
        VersionMismatchError: The robot's firmware uses other checksums.
    """
    deadline_ns = clock.now_ns() + round(CONNECT_TIMEOUT_S * 1e9)
    while stream.accepted < _FIRST_STATES and (left_ns := deadline_ns - clock.now_ns()) > 0:
        if stream.errors >= _TOO_MANY and (error := stream.complaint()) is not None:
            raise error
        with contextlib.suppress(TransportTimeoutError):
            pump(left_ns * 1e-9)
    if stream.accepted < _FIRST_STATES:
        raise stream.complaint() or TransportTimeoutError(_why_silent(transport, stream))
    if stream.doubled:
        raise WrongDeviceError(
            f"go2: two robots send {topics.LOW_STATE}, or one twice: {stream.stale} of "
            f"{stream.accepted + stream.stale} states were no newer than the one before."
            f"{_seen_writing(transport)} Choose another interface, domain or bridge"
        )


def _why_silent(transport: TopicTransport, stream: StateStream) -> str:
    where = getattr(transport, "port", type(transport).__name__)
    if stream.stale:
        return (
            f"go2 on {where}: states arrive, but {stream.standstill}; restart the robot, or continue a "
            "paused simulator"
        )
    return (
        f"go2 on {where}: no {topics.LOW_STATE} within {CONNECT_TIMEOUT_S:g} s.{_seen_writing(transport)} Is "
        "the robot on and booted, the cable in, the interface the one with an address 192.168.123.x (the "
        "robot is 192.168.123.161), and does the firewall let UDP through? Over Zenoh: does the bridge "
        f"carry {topics.LOW_STATE}?"
    )


def _seen_writing(transport: TopicTransport) -> str:
    writers = transport.writers(topics.LOW_STATE)
    return f" Seen writing it: {'; '.join(writers)}." if writers else ""
