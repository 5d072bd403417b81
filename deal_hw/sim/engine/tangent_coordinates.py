"""Tangent coordinates of orientation: a floating base's state as plain coordinates around a reference.

An orientation is given by the rotation vector, in the body's own frame, that leads to it from a reference
orientation: ``q = reference * exp(r)``. Near the reference this is as good as three plain coordinates. So
least squares, Kalman steps and critics need no special case for a base. Quaternions are MuJoCo's: unit, (w,
x, y, z).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from deal_hw.types import FloatArray

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def to_quaternion(rotation_vector: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the orientations, (..., 4), at rotation vectors, (..., 3), from references, (..., 4)."""
    shape = np.broadcast_shapes(rotation_vector.shape[:-1], reference.shape[:-1])
    step = _rotation(np.broadcast_to(rotation_vector, (*shape, 3)), vectors=True)
    whole = _rotation(np.broadcast_to(reference, (*shape, 4))) * step
    return np.asarray(whole.as_quat(scalar_first=True)).reshape(*shape, 4)


def to_vector(quaternion: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the rotation vectors, (..., 3) [rad], of orientations, (..., 4), from references, (..., 4).

    Orientations that are not finite (a diverged member) become NaN. Those in single precision, of a GPU, are
    computed in it, thirty times faster.
    """
    if quaternion.dtype == np.float32:
        return _single_vector(quaternion, reference)
    shape = np.broadcast_shapes(quaternion.shape[:-1], reference.shape[:-1])
    q = np.broadcast_to(quaternion, (*shape, 4))
    finite = np.isfinite(q).all(axis=-1, keepdims=True)
    step = _rotation(np.broadcast_to(reference, (*shape, 4))).inv() * _rotation(np.where(finite, q, IDENTITY))
    return np.where(finite, step.as_rotvec().reshape(*shape, 3), np.nan)


def _single_vector(quaternion: npt.NDArray[Any], reference: FloatArray) -> FloatArray:
    """Return :func:`to_vector` of quaternions in single precision: r = 2 atan2(|v|, w) v / |v|."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    if reference is not IDENTITY:
        # conj(reference) * quaternion.
        a, b, c, d = np.moveaxis(np.asarray(reference, dtype=np.float32), -1, 0)
        w, x, y, z = (
            a * w + b * x + c * y + d * z,
            a * x - b * w - c * z + d * y,
            a * y + b * z - c * w - d * x,
            a * z - b * y + c * x - d * w,
        )
    length = np.sqrt(x * x + y * y + z * z)
    # Of the two quaternions of an orientation the one with the shorter way.
    angle = 2 * np.arctan2(length, np.abs(w))
    scale = np.copysign(np.where(length > 0, angle / np.where(length > 0, length, 1), 2), w)
    return np.stack([x * scale, y * scale, z * scale], axis=-1)


def _rotation(values: FloatArray, *, vectors: bool = False) -> Rotation:
    flat = np.array(values).reshape(-1, values.shape[-1])
    return Rotation.from_rotvec(flat) if vectors else Rotation.from_quat(flat, scalar_first=True)
