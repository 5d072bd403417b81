"""LowCmd: PD targets for a Go2's motors."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deal_hw.drivers.go2.messages.wire import SLOT
from deal_hw.drivers.unitree.go_messages import low_command
from deal_hw.drivers.unitree.go_messages.layout import SLOTS
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.types import IntArray


@dataclass(frozen=True, slots=True)
class LowCommand(low_command.GoCommand):
    """PD targets for the 12 motors, arrays (12,) in model order; the motors are on unless told otherwise."""

    mode: IntArray = field(default_factory=lambda: np.ones(12, np.int64))


class LowCommandEncoder(low_command.GoCommandEncoder):
    """Writes LowCmds for 12 motors into a buffer of its own and returns copies; one for each thread.

    Args:
        servo: Mode in the slots without a motor, as the vendor's examples fill them.
    """

    def __init__(self, servo: int = MODE_SERVO) -> None:
        super().__init__(SLOT, np.full(SLOTS, servo))


def decode_low_command(payload: bytes) -> LowCommand:
    """Return the command in a LowCmd, as a robot would take it.

    Raises:
        FrameError: Wrong length, header, head, level flag or checksum, or a reserved field that is not 0.
    """
    c = low_command.decode_low_command(payload, SLOT)
    return LowCommand(c.position, c.velocity, c.stiffness, c.damping, c.effort, c.mode, c.level)
