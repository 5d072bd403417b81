"""Places of a robot's parts at joint positions."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from deal_hw.sim.engine.model import RobotModel
from deal_hw.types import FloatArray


def point_positions(robot: RobotModel, body: str, point: Sequence[float], joints: FloatArray) -> FloatArray:
    """Return where a point of a body is at joint positions, in the world, (S, 3) [m].

    Args:
        robot: A robot with a fixed base.
        body: The body.
        point: The point in the body's frame, (3,) [m].
        joints: Positions of the joints, (S, J) [rad or m].
    """
    data = mujoco.MjData(robot.model)
    found = np.empty((len(joints), 3))
    for row, position in enumerate(joints):
        robot.place(data.qpos, position)
        mujoco.mj_kinematics(robot.model, data)
        place = data.body(body)
        found[row] = place.xpos + place.xmat.reshape(3, 3) @ np.asarray(point)
    return found
