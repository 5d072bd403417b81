"""Rotation vectors and unit quaternions (wxyz)."""

from __future__ import annotations

import math

import numpy as np

from deal_hw.types import FloatArray


def in_base_frame(rotation_vector: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors of the world, (..., 3), in the frame of a base at rotation vectors, (..., 3).

    Rodrigues' formula for the inverse rotation.
    """
    angle = np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    axis = rotation_vector / np.where(angle > 0, angle, 1.0)
    along = np.sum(axis * vector, axis=-1, keepdims=True)
    turned = np.cos(angle) * vector - np.sin(angle) * np.cross(axis, vector)
    return np.asarray(turned + (1.0 - np.cos(angle)) * along * axis)


def rotated(orientation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors of a base's frame, (T, 3), in the world, for orientations wxyz, (T, 4)."""
    axis = orientation[:, 1:]
    turned = np.cross(axis, vectors)
    return np.asarray(vectors + 2.0 * (orientation[:, :1] * turned + np.cross(axis, turned)))


def heading(orientation: FloatArray) -> FloatArray:
    """Return the angle of a base's x axis seen from above, (...) [rad], for orientations wxyz, (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(orientation), -1, 0)
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def rotation_vector(quaternion: FloatArray) -> FloatArray:
    """Return the rotation vector, (3,) [rad], of an orientation, (4,), a unit quaternion wxyz."""
    w, v = float(quaternion[0]), quaternion[1:]
    sine = float(np.linalg.norm(v))
    # Of a rotation's two quaternions, take the one with the smaller angle.
    angle = 2.0 * math.atan2(sine, abs(w))
    return np.asarray(v * (math.copysign(1.0, w) * (angle / sine if sine > 0 else 2.0)))


def rotation_between(present: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the rotation vectors in the world, (..., 3) [rad], that turn orientations to wanted ones.

    Args:
        present: Orientations as rotation vectors around the identity, (..., 3).
        wanted: The same.
    """
    # The quaternion wanted * conjugate(present); of its two signs, the one with the smaller angle.
    (w, v), (b, u) = _half_turn(wanted), _half_turn(present)
    real = w * b + np.sum(v * u, axis=-1, keepdims=True)
    imaginary = (b * v - w * u - np.cross(v, u)) * np.where(real < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(imaginary, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(real))
    return np.asarray(imaginary * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0))


def _half_turn(turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the real, (..., 1), and the imaginary part, (..., 3), of the quaternion of a rotation vector."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    # numpy's sinc(x) is sin(pi x) / (pi x).
    return np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * turn
