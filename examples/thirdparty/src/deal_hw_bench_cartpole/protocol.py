"""The robot's serial protocol: pure functions between bytes and values, without I/O and without a clock.

Written from the public firmware and PC driver of SensorsINI/physical-cartpole (functions of 2024 and 2026).
A frame is AA, command, length of the whole frame, payload, CRC-8 (Maxim) over all bytes before it; numbers
are little-endian. 230400 baud, 8N1.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Final

from fastcrc import crc8

BAUD_RATE: Final = 230_400
SYNC: Final = 0xAA
OVERHEAD: Final = 4
"""Bytes of a frame beside its payload."""
FULL_SCALE: Final = 7200
"""PWM counts of the timer's period; the firmware clips commands at 0.95 of it."""
LARGEST_COMMAND: Final = 6840
"""0.95 of the full scale [counts]."""


class Command(enum.IntEnum):
    """The commands that this driver uses. A ping comes back as it was sent."""

    PING = 0xC0
    STREAM = 0xC1
    CALIBRATE = 0xC2
    CONFIGURE = 0xC6
    MOTOR = 0xC8
    PC_CONTROL = 0xCB
    STATE = 0xCC


_STATE: Final = {
    31: struct.Struct("<hfhfhBIIHH"),
    36: struct.Struct("<hfhfhBIQHHB"),
    40: struct.Struct("<hfhfhBIQHHBf"),
}
"""Layouts of a state by its frame's length: the firmware has no version number."""


@dataclass(frozen=True, slots=True)
class State:
    """A state of the robot, in its own units.

    Attributes:
        angle: The pole's encoder [counts of the analogue converter].
        position: The cart's encoder, from the centre [counts].
        motor: Motor command in force [PWM counts].
        time_us: The robot's clock [us].
        length: Length of the state's frame, which names the firmware's layout.
    """

    angle: int
    position: int
    motor: int
    time_us: int
    length: int = 31


def frame(command: int, payload: bytes = b"") -> bytes:
    """Return a frame."""
    body = bytes((SYNC, command, len(payload) + OVERHEAD)) + payload
    return body + bytes((crc8.maxim_dow(body),))


def motor(counts: int) -> bytes:
    """Return the frame of a motor command [PWM counts]."""
    return frame(Command.MOTOR, struct.pack("<i", counts))


def switch(command: Command, on: bool) -> bytes:
    """Return a frame that switches something on or off."""
    return frame(command, bytes((on,)))


def configure(period_ms: int, length: int) -> bytes:
    """Return the frame that sets the control period, for firmware whose states have this length.

    A command takes effect at the next tick (synchronous). The other values are for the chip's own
    controllers, which are not used.
    """
    if length == 31:
        return frame(Command.CONFIGURE, struct.pack("<H?fH?", period_ms, True, 0.0, 1, False))
    return frame(Command.CONFIGURE, struct.pack("<H?fH?H", period_ms, True, 0.0, 1, False, 1))


def encode_state(state: State) -> bytes:
    """Return the frame of a state, as the robot sends it."""
    layout = _STATE[state.length]
    rest: tuple[float, ...] = {31: (), 36: (0,), 40: (0, 1.0)}[state.length]
    time_us = state.time_us & 0xFFFF_FFFF if state.length == 31 else state.time_us
    values = (state.angle, 0.0, state.position, 0.0, state.motor, 0, 0, time_us, 0, 0, *rest)
    return frame(Command.STATE, layout.pack(*values))


def decode_state(data: bytes) -> State | None:
    """Return the state in a whole frame with a right checksum; None if this layout is not known."""
    layout = _STATE.get(len(data))
    if layout is None:
        return None
    angle, _, position, _, command, _, _, time_us, *_ = layout.unpack(data[3:-1])
    return State(angle, position, command, time_us, len(data))


class Splitter:
    """Finds frames in a stream of bytes that may be torn or damaged.

    Attributes:
        errors: Places where bytes were no frame.
        skipped: Bytes that were no frame.
    """

    def __init__(self) -> None:
        self.errors = self.skipped = 0
        self._rest = b""
        self._lost = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes; return the whole frames among them and the bytes before."""
        found, rest = [], self._rest + data
        while rest:
            size = rest[2] if len(rest) > 2 else OVERHEAD
            fits = rest[0] == SYNC and size >= OVERHEAD
            if fits and len(rest) < size:
                break
            if fits and crc8.maxim_dow(rest[: size - 1]) == rest[size - 1]:
                found.append(rest[:size])
                rest, self._lost = rest[size:], False
                continue
            # One damaged frame is one error, however many bytes are skipped until the next.
            self.errors += not self._lost
            self._lost, rest = True, rest[1:]
            self.skipped += 1
        self._rest = rest
        return found
