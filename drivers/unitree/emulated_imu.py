"""Orientations that an emulated robot's inertial sensor reports."""

from __future__ import annotations

import math

import numpy as np

from deal_hw.types import FloatArray


def turned(orientation: FloatArray, angles: FloatArray) -> FloatArray:
    """Return a quaternion turned by small angles about its own axes, to first order."""
    w, x, y, z = orientation
    a, b, c = angles / 2
    turned = np.array(
        (
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
        )
    )
    return np.asarray(turned / math.sqrt(turned @ turned))


def roll_pitch_yaw(w: float, x: float, y: float, z: float) -> FloatArray:
    """Return roll, pitch and yaw of a unit quaternion, (3,) [rad]."""
    return np.array(
        (
            math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x)))),
            math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        )
    )
