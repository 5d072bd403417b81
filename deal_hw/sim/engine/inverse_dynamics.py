"""Torques that move a robot's links along a motion."""

from __future__ import annotations

import mujoco
import numpy as np

from deal_hw.sim.engine.model import RobotModel
from deal_hw.types import FloatArray


def link_torques(
    robot: RobotModel, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Return the joint torques that move the links of a robot with a fixed base, (T, J) [N m or N].

    Rotors' inertia, friction and damping of joints do not count: with a gear they act on the motor's side.

    Args:
        robot: The robot.
        position: Joint positions, (T, J) [rad or m].
        velocity: Joint velocities, (T, J).
        acceleration: Joint accelerations, (T, J).
    """
    model, dofs = robot.model, list(robot.qvel)
    data = mujoco.MjData(model)
    found, torque = np.empty(position.shape), np.zeros(model.nv)
    for k in range(len(position)):
        robot.place(data.qpos, position[k], data.qvel, velocity[k])
        data.qacc[dofs] = acceleration[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        # The recursion knows bodies only.
        mujoco.mj_rne(model, data, 1, torque)
        found[k] = torque[dofs]
    return found
