"""What an H1's states say beside the message: which robot it is, and how its pelvis lies and turns."""

from __future__ import annotations

import math
from typing import ClassVar, Final

import numpy as np

from deal_hw.drivers.go2.messages.refusals import Refusals
from deal_hw.drivers.h1.joints import ORDER, TORSO
from deal_hw.drivers.unitree.go_messages.low_state import LowStateDecoder, LowStateFrame
from deal_hw.types import FloatArray

FOUR_LEGS: Final = (
    "its arms' motors (12 to 19) report nothing at all, as those of a Go2 or B2, which have the same "
    "messages: take robot `go2` or `b2` if it is one"
)
_ARM_JOINTS: Final = np.flatnonzero(ORDER.motors >= 12)
"""Joints whose motors a Go2 or B2 has not."""


class H1Refusals(Refusals):
    """Counts refused states of an H1."""

    robot: ClassVar[tuple[str, str]] = ("h1", "H1")


class H1StateDecoder(LowStateDecoder):
    """Reads LowStates of an H1."""

    def __init__(self) -> None:
        super().__init__(ORDER)


def has_four_legs(frame: LowStateFrame) -> bool:
    """Return whether a state is that of a Go2 or B2: nothing in the slots of an H1's arms."""
    return not (frame.position[_ARM_JOINTS].any() or frame.temperature[_ARM_JOINTS].any())


def pelvis_motion(
    orientation: FloatArray,
    angular_velocity: FloatArray,
    specific_force: FloatArray,
    torso: float,
    torso_velocity: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return orientation, angular velocity and specific force of the pelvis from the torso's.

    The sensor is in the torso, which turns about the pelvis's z axis. The specific force is that at the
    sensor; the difference by the torso's turning is left out.

    Args:
        orientation: Quaternion wxyz of the torso in the world, (4,).
        angular_velocity: In the torso's frame, (3,) [rad/s].
        specific_force: In the torso's frame, (3,) [m/s²].
        torso: Angle of the torso's joint [rad].
        torso_velocity: Its speed [rad/s].
    """
    w, x, y, z = orientation
    c, s = math.cos(torso / 2), math.sin(torso / 2)
    turned = np.array((w * c + z * s, x * c - y * s, y * c + x * s, z * c - w * s))
    cosine, sine = math.cos(torso), math.sin(torso)
    rotation = np.array(((cosine, -sine, 0.0), (sine, cosine, 0.0), (0.0, 0.0, 1.0)))
    turning = rotation @ angular_velocity
    turning[2] -= torso_velocity
    return turned, turning, rotation @ specific_force


def pelvis_of(frame: LowStateFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return orientation, angular velocity and specific force of the pelvis in a state."""
    return pelvis_motion(
        frame.orientation,
        frame.angular_velocity,
        frame.specific_force,
        float(frame.position[TORSO]),
        float(frame.velocity[TORSO]),
    )
