"""A command to the motors, whatever its message."""

from __future__ import annotations

from typing import Final, Protocol

from deal_hw.errors import FrameError
from deal_hw.types import FloatArray, IntArray

MODE_OFF: Final = 0x00
MODE_SERVO: Final = 0x01
POSITION_STOP: Final = 2.146e9
VELOCITY_STOP: Final = 16000.0
"""Position and velocity in the vendor's examples for motors without a command; kp = kd = 0 there."""


_LARGEST: Final = 1e30
"""Bound on the sum of squares of a command's numbers; stop values have 5.5e19."""


def check_numbers(values: FloatArray) -> None:
    """Refuse a command's numbers, (n,), of which one is not finite or implausibly large.

    Raises:
        FrameError: One is.
    """
    if not values.dot(values) < _LARGEST:
        raise FrameError(
            "a LowCmd's numbers must be finite and of a plausible size; this command is not sent"
        )


class MotorCommand(Protocol):
    """PD targets for the motors, (J,) each in model order."""

    @property
    def position(self) -> FloatArray:
        """Targets [rad]."""
        ...

    @property
    def velocity(self) -> FloatArray:
        """Targets [rad/s]."""
        ...

    @property
    def stiffness(self) -> FloatArray:
        """Gains [N·m/rad]."""
        ...

    @property
    def damping(self) -> FloatArray:
        """Gains [N·m·s/rad]."""
        ...

    @property
    def effort(self) -> FloatArray:
        """Feed-forward [N·m]."""
        ...

    @property
    def mode(self) -> IntArray:
        """The servo's number (1 on most robots), 0 off."""
        ...
