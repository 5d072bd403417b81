"""The vendor's sport mode, as far as an emulator needs it: it stands up, lies down and damps.

It commands the motors every 2 ms until it is released, even while other programs do. It does not walk: it
answers a Move, and the robot stays in place.
"""

from __future__ import annotations

import enum
from typing import Final

import numpy as np

from deal_hw.drivers.go2.messages.low_command import LowCommand
from deal_hw.drivers.unitree.emulated_quadruped import SportGains
from deal_hw.drivers.unitree.motor_command import MODE_SERVO
from deal_hw.types import FloatArray

PERIOD_MS: Final = 2
STANDING: Final = np.tile((0.0, 0.67, -1.3), 4)
LYING: Final = np.tile((0.0, 1.36, -2.65), 4)
"""Poses of unitree_sdk2_python's go2_stand_example; those of b2_stand_example are the same."""
_ZEROS: Final = np.zeros(12)


class Posture(enum.Enum):
    """Posture of sport mode; the value is SportModeState's ``mode``."""

    STANDING = 6
    """Joints locked, as after StandUp."""
    BALANCING = 1
    DOWN = 5
    DAMPING = 7
    RECOVERING = 8


_WAYS: Final = {
    Posture.STANDING: ((1.2, STANDING),),
    Posture.BALANCING: ((1.2, STANDING),),
    Posture.DOWN: ((1.5, LYING),),
    Posture.RECOVERING: ((1.0, LYING), (1.2, STANDING)),
}
"""Poses of a movement, each with the time to reach it [s]."""
_UPRIGHT: Final = (Posture.STANDING, Posture.BALANCING, Posture.RECOVERING)


class SportController:
    """A stand controller that moves along straight lines in joint space and holds their end.

    Attributes:
        posture: Its present posture.
        velocity: Walking speed requested last: ahead, left, turn [m/s, rad/s]; it never walks.

    Args:
        gains: Of its commands.
        mode: Motor mode of its commands.
    """

    def __init__(self, gains: SportGains, mode: int = MODE_SERVO) -> None:
        self._mode = np.full(12, mode)
        self._stiff, self._damped = np.full(12, gains.stiffness), np.full(12, gains.damping)
        self._released = np.full(12, gains.released)
        self.posture = Posture.DAMPING
        self.velocity = (0.0, 0.0, 0.0)
        self._begin_ms = 0
        self._from = _ZEROS

    def take(self, posture: Posture, position: FloatArray, now_ms: int) -> None:
        """Go into a posture from measured positions, (12,) [rad]."""
        self.velocity = (0.0, 0.0, 0.0)
        if posture is self.posture:
            # The vendor's example requests StandDown every second until the mode is released. If each
            # request started anew, the movement would never end.
            return
        stands = self.posture in _UPRIGHT and self.progress(now_ms) >= 1.0
        self.posture = posture
        if stands and posture in _UPRIGHT:
            return
        self._begin_ms, self._from = now_ms, position.copy()

    def progress(self, now_ms: int) -> float:
        """Return the progress of the movement to the posture, 0 to 1."""
        total_s = sum(seconds for seconds, _ in _WAYS.get(self.posture, ()))
        return min(1.0, (now_ms - self._begin_ms) * 1e-3 / total_s) if total_s else 1.0

    def command(self, now_ms: int) -> LowCommand:
        """Return the present command to the motors."""
        if self.posture is Posture.DAMPING:
            return self._damping()
        since_s = (now_ms - self._begin_ms) * 1e-3
        before = self._from
        for seconds, pose in _WAYS[self.posture]:
            if since_s < seconds:
                target = before + (pose - before) * (since_s / seconds)
                return self._hold(target)
            since_s -= seconds
            before = pose
        if self.posture is Posture.DOWN:
            return self._damping()
        return self._hold(before)

    def _hold(self, position: FloatArray) -> LowCommand:
        return LowCommand(position, _ZEROS, self._stiff, self._damped, _ZEROS, self._mode)

    def _damping(self) -> LowCommand:
        return LowCommand(_ZEROS, _ZEROS, _ZEROS, self._released, _ZEROS, self._mode)
