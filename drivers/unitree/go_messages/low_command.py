"""LowCmd: PD targets for the motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.cdr import CDR_HEADER, CRC_START, words_crc
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.drivers.unitree.go_messages.frames import (
    HEAD,
    LEVEL_LOW,
    check_frame,
    low_command_image,
    verify_crc,
)
from deal_hw.drivers.unitree.go_messages.layout import LOW_COMMAND_BYTES
from deal_hw.drivers.unitree.motor_command import POSITION_STOP, VELOCITY_STOP, check_numbers
from deal_hw.errors import FrameError
from deal_hw.types import FloatArray, IntArray

_FIELD_COUNT: Final = 5


@dataclass(frozen=True, slots=True)
class GoCommand:
    """PD targets for the motors, arrays (J,) in the robot's own order.

    Attributes:
        position: Targets q [rad].
        velocity: Targets dq [rad/s].
        stiffness: kp [N·m/rad].
        damping: kd [N·m·s/rad].
        effort: Feed-forward tau [N·m].
        mode: The servo's number (1 on a Go2), 0 off.
        level: 0xFF: to the motors themselves.
    """

    position: FloatArray
    velocity: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    effort: FloatArray
    mode: IntArray
    level: int = LEVEL_LOW


class GoCommandEncoder:
    """Writes LowCmds into a buffer of its own and returns copies; one for each thread.

    Args:
        motors: Motor slot of each joint, (J,).
        spare: Mode of each slot while it has no joint, as the vendor's examples fill it, (20,).
    """

    def __init__(self, motors: IntArray, spare: IntArray) -> None:
        self._buffer = bytearray(LOW_COMMAND_BYTES)
        record = np.frombuffer(self._buffer, layout.LOW_COMMAND)[0]
        record["encapsulation"] = tuple(CDR_HEADER)
        record["head"] = tuple(HEAD)
        numbers = record["motor"]
        numbers["q"], numbers["dq"] = POSITION_STOP, VELOCITY_STOP
        # (20, 8) floats, whose rows' first five are q, dq, tau, kp, kd; the rest is reserved and stays 0.
        self._rows: np.ndarray[tuple[int, int], np.dtype[np.float32]] = np.ndarray(
            (layout.SLOTS, _FIELD_COUNT), "<f4", self._buffer, offset=28, strides=(36, 4)
        )
        self._bytes = np.frombuffer(self._buffer, "u1")
        self._bytes[layout.COMMAND_MODE_AT] = spare
        self._mode_at = layout.COMMAND_MODE_AT[motors]
        count, order = len(motors), np.argsort(motors)
        used = motors[order]
        # A slice is faster than numbers, and the motors of most robots have no gap.
        self._used = slice(count) if used[-1] == count - 1 else used
        # Index in a flat (5, J) array of each number in the wire's rows, (J, 5).
        self._wire_rows = order[:, None] + count * np.arange(_FIELD_COUNT)[None, :]
        self._values = np.empty((_FIELD_COUNT, count))
        self._flat = self._values.reshape(-1)
        self._mode, self._level = b"", -1
        self._start = CRC_START

    def encode(self, command: GoCommand) -> bytes:
        """Return the command as CDR with header and checksum, 812 bytes.

        Raises:
            FrameError: A number is not finite, or implausibly large.
        """
        values = self._values
        values[0], values[1], values[2] = command.position, command.velocity, command.effort
        values[3], values[4] = command.stiffness, command.damping
        check_numbers(self._flat)
        self._rows[self._used] = values.take(self._wire_rows)
        if (mode := command.mode.tobytes()) != self._mode or command.level != self._level:
            self._set_modes(command)
            self._mode, self._level = mode, command.level
        crc = words_crc(self._buffer[28:808], self._start)
        self._buffer[808:] = crc.to_bytes(4, "little")
        return bytes(self._buffer)

    def _set_modes(self, command: GoCommand) -> None:
        self._bytes[self._mode_at] = command.mode
        self._buffer[6] = command.level
        # The struct's first 28 bytes hold no motor's numbers, so their part of the checksum is kept.
        self._start = words_crc(low_command_image(bytes(self._buffer))[:28])


def decode_low_command(payload: bytes, motors: IntArray) -> GoCommand:
    """Return the command in a LowCmd, as a robot with these motors would take it.

    Args:
        payload: CDR with its header.
        motors: Motor slot of each joint, (J,).

    Raises:
        FrameError: Wrong length, header, head, level flag or checksum, or a reserved field that is not 0.
    """
    check_frame(payload, "LowCmd")
    record = np.frombuffer(payload, layout.LOW_COMMAND)[0]
    verify_crc(payload, "LowCmd")
    if payload[6] != LEVEL_LOW:
        raise FrameError(
            f"LowCmd: level_flag is 0x{payload[6]:02X}; commands to the motors have 0x{LEVEL_LOW:02X}"
        )
    if payload[7] or record["reserve"] or record["bms_reserve"].any() or record["motor"]["reserve"].any():
        raise FrameError(
            "LowCmd: reserved fields are set; the sender uses another version, or another layout"
        )
    numbers = record["motor"][motors]
    modes = np.frombuffer(payload, "u1")[layout.COMMAND_MODE_AT[motors]]
    q, dq, kp, kd, tau = (numbers[name].astype(np.float64) for name in ("q", "dq", "kp", "kd", "tau"))
    return GoCommand(q, dq, kp, kd, tau, modes.astype(np.int64), payload[6])
