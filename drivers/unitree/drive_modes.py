"""What the drives of a robot say of themselves: whether a drive that was on goes off during a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.motor_command import MODE_OFF
from deal_hw.types import IntArray

OFF_STATES: Final = 10
"""Consecutive states that say "off" before it counts: one odd byte is no reason to let a robot go."""


class DriveModes:
    """Watches each motor's mode byte for a change from "on" to "off".

    Some programs that play a robot never fill the byte in. A motor that never said "on" is therefore not
    judged.

    Args:
        name: What messages call the robot.
        joints: Names of the joints, (J,).
    """

    def __init__(self, name: str, joints: Sequence[str]) -> None:
        self._name, self._joints = name, joints
        self.reset()

    def reset(self) -> None:
        """Begin anew: no motor has said anything."""
        self._was_on = np.zeros(len(self._joints), bool)
        self._off_states = 0

    def complaint(self, mode: IntArray) -> str:
        """Take the next state's modes, (J,); return which drive went off, or ""."""
        off = self._was_on & (mode == MODE_OFF)
        self._was_on |= mode != MODE_OFF
        self._off_states = self._off_states + 1 if off.any() else 0
        if self._off_states < OFF_STATES:
            return ""
        names = ", ".join(repr(name) for name, is_off in zip(self._joints, off, strict=True) if is_off)
        return (
            f"{self._name}: the robot says that its motor of joint {names} is off (mode 0); it was on. Look "
            "for a motor that is hot, a loose cable, and another program that switched it off"
        )
