"""Positions of a quadruped's feet, and the loads of its legs from its motors' efforts, in closed form.

Arrays follow model order (legs FL, FR, RL, RR; hip, thigh, calf); vectors are in the base's frame: x ahead,
y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.types import FloatArray

_LEFT: Final = np.array([1.0, -1.0, 1.0, -1.0])
_AHEAD: Final = np.array([1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class LegGeometry:
    """Legs of a quadruped whose thighs and calves are equally long.

    Attributes:
        link_m: Length of a thigh, and of a calf up to the foot's centre [m].
        side_m: Distance from the axis of a hip joint to its leg's plane [m].
        foot_m: Radius of a foot [m].
        hip_m: Place of the front left hip joint in the base's frame, ahead and to the left [m].
        weight_n: Weight of the robot [N].
    """

    link_m: float
    side_m: float
    foot_m: float
    hip_m: tuple[float, float]
    weight_n: float

    @property
    def _hips(self) -> FloatArray:
        """Places of the hip joints, (4, 3) [m]."""
        ahead, left = self.hip_m
        return np.stack((ahead * _AHEAD, left * _LEFT, np.zeros(4)), axis=-1)

    def foot_positions(self, position: FloatArray) -> FloatArray:
        """Return the centres of the feet in the base's frame, (..., 4, 3) [m].

        Args:
            position: Joint positions, (..., 12) [rad].
        """
        hip, thigh, calf = _legs(position)
        ahead = -self.link_m * (np.sin(thigh) + np.sin(thigh + calf))
        up = -self.link_m * (np.cos(thigh) + np.cos(thigh + calf))
        side = self.side_m * _LEFT
        turned = (ahead, side * np.cos(hip) - up * np.sin(hip), side * np.sin(hip) + up * np.cos(hip))
        return np.asarray(self._hips + np.stack(turned, axis=-1))

    def foot_jacobians(self, position: FloatArray) -> FloatArray:
        """Return the Jacobian of each foot, (..., 4, 3, 3) [m/rad]; columns are its leg's joints.

        Args:
            position: Joint positions, (..., 12) [rad].
        """
        hip, thigh, calf = _legs(position)
        foot = self.foot_positions(position) - self._hips
        axis = np.array([1.0, 0.0, 0.0])
        by_hip = np.cross(axis, foot)

        def swing(ahead: FloatArray, up: FloatArray) -> FloatArray:
            return np.stack((ahead, -up * np.sin(hip), up * np.cos(hip)), axis=-1)

        knee, link = thigh + calf, self.link_m
        by_calf = swing(-link * np.cos(knee), link * np.sin(knee))
        by_thigh = by_calf + swing(-link * np.cos(thigh), link * np.sin(thigh))
        return np.stack((by_hip, by_thigh, by_calf), axis=-1)

    def foot_loads(self, position: FloatArray, effort: FloatArray) -> FloatArray:
        """Return the force of the floor on each foot that balances the motors' efforts, (..., 4, 3) [N].

        The legs' own weight is neglected: in the air a leg shows it as a small negative load. The calves'
        range keeps the equations regular.

        Args:
            position: Joint positions, (..., 12) [rad].
            effort: Efforts of the motors, (..., 12) [N·m].
        """
        transposed = np.swapaxes(self.foot_jacobians(position), -1, -2)
        return np.asarray(-np.linalg.solve(transposed, effort.reshape(*effort.shape[:-1], 4, 3, 1))[..., 0])


def _legs(position: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return hips, thighs and calves, (..., 4) each, of joint positions, (..., 12)."""
    hip, thigh, calf = np.moveaxis(position.reshape(*position.shape[:-1], 4, 3), -1, 0)
    return hip, thigh, calf
