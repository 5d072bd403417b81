"""Positions of a Go2's feet, and the loads of its legs from its motors' efforts; closed form, no simulator.

Lengths as in ``assets/go2.xml``. Arrays follow model order (legs FL, FR, RL, RR; hip, thigh, calf); vectors
are in the base's frame: x ahead, y left, z up.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.drivers.go2.descriptions.floor import LEGS
from deal_hw.types import FloatArray

LINK_M: Final = 0.213
"""Length of a thigh, and of a calf up to the foot's centre [m]."""
SIDE_M: Final = 0.0955
"""Distance from the axis of a hip joint to its leg's plane [m]."""
WEIGHT_N: Final = 149.0
"""15.2 kg, the mass of ``go2.xml`` [N]."""
_LEFT: Final = np.array([1.0 if leg.endswith("L") else -1.0 for leg in LEGS])
_HIP: Final = np.array([(0.1934 if leg.startswith("F") else -0.1934, 0.0465, 0.0) for leg in LEGS])
_HIP[:, 1] *= _LEFT


def _legs(position: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hips, thighs and calves, (..., 4) each, of joint positions, (..., 12)."""
    hip, thigh, calf = np.moveaxis(position.reshape(*position.shape[:-1], 4, 3), -1, 0)
    return hip, thigh, calf


def foot_positions(position: FloatArray) -> FloatArray:
    """Return the centres of the feet in the base's frame, (..., 4, 3) [m].

    Args:
        position: Joint positions, (..., 12) [rad].
    """
    hip, thigh, calf = _legs(position)
    ahead = -LINK_M * (np.sin(thigh) + np.sin(thigh + calf))
    up = -LINK_M * (np.cos(thigh) + np.cos(thigh + calf))
    side = SIDE_M * _LEFT
    turned = (ahead, side * np.cos(hip) - up * np.sin(hip), side * np.sin(hip) + up * np.cos(hip))
    return np.asarray(_HIP + np.stack(turned, axis=-1))


def foot_jacobians(position: FloatArray) -> FloatArray:
    """Return the Jacobian of each foot, (..., 4, 3, 3) [m/rad]; columns are its leg's joints.

    Args:
        position: Joint positions, (..., 12) [rad].
    """
    hip, thigh, calf = _legs(position)
    foot = foot_positions(position) - _HIP
    axis = np.array([1.0, 0.0, 0.0])
    by_hip = np.cross(axis, foot)

    def swing(ahead: FloatArray, up: FloatArray) -> FloatArray:
        return np.stack((ahead, -up * np.sin(hip), up * np.cos(hip)), axis=-1)

    knee = thigh + calf
    by_calf = swing(-LINK_M * np.cos(knee), LINK_M * np.sin(knee))
    by_thigh = by_calf + swing(-LINK_M * np.cos(thigh), LINK_M * np.sin(thigh))
    return np.stack((by_hip, by_thigh, by_calf), axis=-1)


def foot_loads(position: FloatArray, effort: FloatArray) -> FloatArray:
    """Return the force of the floor on each foot that balances the motors' efforts, (..., 4, 3) [N].

    The legs' own weight is neglected: in the air a leg shows it as a small negative load. The calves' range
    keeps the equations regular.

    Args:
        position: Joint positions, (..., 12) [rad].
        effort: Efforts of the motors, (..., 12) [N·m].
    """
    transposed = np.swapaxes(foot_jacobians(position), -1, -2)
    return np.asarray(-np.linalg.solve(transposed, effort.reshape(*effort.shape[:-1], 4, 3, 1))[..., 0])
