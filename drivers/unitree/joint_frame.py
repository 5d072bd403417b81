"""A received LowState whose numbers that every control cycle reads are unpacked; the others are not."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.types import FloatArray, IntArray

_PARTS: Final = 4
"""Numbers of a motor that are unpacked: q, dq, ddq and tau_est, in this order."""
_F4: Final = np.dtype("<f4")
_F8: Final = np.dtype(np.float64)


def hot_words(motors: IntArray, first: int, stride: int, body: int) -> IntArray:
    """Return the 32-bit words of a LowState that a :class:`JointFrame` unpacks.

    Args:
        motors: Motor slot of each joint, (J,).
        first: Word of q in slot 0.
        stride: Words of a motor.
        body: Word of the quaternion; gyroscope, accelerometer and rpy follow.
    """
    joints = first + stride * motors
    return np.concatenate([*(joints + part for part in range(_PARTS)), np.arange(body, body + 13)])


class JointFrame:
    """A received LowState: motors and inertial sensor.

    Attributes:
        payload: The bytes.

    Args:
        payload: The bytes.
        hot: What :func:`hot_words` returned for the message and the joints.
        joints: Number of joints, J.
    """

    __slots__ = ("_hot", "_joints", "payload")

    def __init__(self, payload: bytes, hot: IntArray, joints: int) -> None:
        self.payload, self._joints = payload, joints
        self._hot: FloatArray = np.frombuffer(payload, _F4)[hot].astype(_F8)

    @property
    def position(self) -> FloatArray:
        """q, (J,) [rad]."""
        return self._part(0)

    @property
    def velocity(self) -> FloatArray:
        """The joints' dq, (J,) [rad/s]."""
        return self._part(1)

    @property
    def acceleration(self) -> FloatArray:
        """The joints' ddq, (J,) [rad/s²]."""
        return self._part(2)

    @property
    def effort(self) -> FloatArray:
        """The motors' tau_est, (J,) [N·m]."""
        return self._part(3)

    @property
    def orientation(self) -> FloatArray:
        """Quaternion wxyz, the inertial sensor's body in the world, (4,)."""
        return self._hot[-13:-9]

    @property
    def angular_velocity(self) -> FloatArray:
        """In that body's frame, (3,) [rad/s]."""
        return self._hot[-9:-6]

    @property
    def specific_force(self) -> FloatArray:
        """In that body's frame, (3,) [m/s²]."""
        return self._hot[-6:-3]

    @property
    def rpy(self) -> FloatArray:
        """Roll, pitch, yaw, (3,) [rad]."""
        return self._hot[-3:]

    def _part(self, number: int) -> FloatArray:
        return self._hot[number * self._joints : (number + 1) * self._joints]
