"""Mass of a legged robot from its motors' efforts while it stands."""

from __future__ import annotations

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.parameters.fields import element_id
from deal_hw.types import FloatArray


def standing_mass(
    robot: RobotModel, orientation: FloatArray, position: FloatArray, effort: FloatArray
) -> float:
    """Return the mass of the whole robot [kg].

    The floor's forces balance the motors' efforts and the weight of the legs. Dry friction hides a part of
    each joint's effort, and a motor's estimate of its effort is only as good as its maker states. But no
    motion of a robot on its feet separates masses from gains, because all forces scale together.

    Args:
        robot: A robot with a floating base and feet, on a level floor, at rest.
        orientation: Of the base, (T, 4).
        position: Of the joints, (T, J).
        effort: Of the joints, by the motors, (T, J) [N·m].

    Raises:
        ConfigurationError: The robot's base is fixed, or the description names no feet.
    """
    if robot.base is None or not robot.description.feet:
        raise ConfigurationError(
            f"{robot.description.name}: weighing needs a floating base and feet in the description"
        )
    model, data = robot.model, mujoco.MjData(robot.model)
    feet = [element_id(model, "geom", name) for name in robot.description.feet]
    at, dofs, jacobian = robot.base[0], list(robot.qvel), np.empty((3, model.nv))
    borne = np.empty(len(position))
    for t in range(len(position)):
        data.qpos[at + 3 : at + 7] = orientation[t]
        robot.place(data.qpos, position[t])
        mujoco.mj_forward(model, data)
        rows = []
        for foot in feet:
            mujoco.mj_jacGeom(model, data, jacobian, None, foot)
            rows.append(jacobian[:, dofs].copy())
        legs = data.qfrc_bias[dofs] - effort[t]
        force = np.linalg.lstsq(np.concatenate(rows).T, legs, rcond=None)[0]
        borne[t] = force[2::3].sum()
    return float(np.median(borne) / np.linalg.norm(model.opt.gravity))
