"""What an H1's states say beside the message: how its pelvis lies and turns."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from deal_hw.drivers.go2.messages.refusals import Refusals
from deal_hw.drivers.h1.joints import ORDER, TORSO
from deal_hw.drivers.unitree.go_messages.low_state import LowStateDecoder, LowStateFrame
from deal_hw.types import FloatArray


class H1Refusals(Refusals):
    """Counts refused states of an H1."""

    robot: ClassVar[tuple[str, str]] = ("h1", "H1")


class H1StateDecoder(LowStateDecoder):
    """Reads LowStates of an H1."""

    def __init__(self) -> None:
        super().__init__(ORDER)


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
