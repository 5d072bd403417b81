"""Which way a joint's positive direction is, in words, for a person beside the arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.sim.robots.user_robot import UserRobot

_LEAST_SHIFT_M: Final = 0.01
_ENDS: Final = ("-x", "-y", "-z"), ("+x", "+y", "+z")


def positive_directions(robot: UserRobot) -> Callable[[str], str]:
    """Return a function that says in words which way a joint's positive direction is, as the MJCF has it."""
    model = robot.model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for joint in range(model.njnt):
        if model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            data.qpos[model.jnt_qposadr[joint]] = 0.0
    mujoco.mj_kinematics(model, data)

    def words(name: str) -> str:
        joint = model.joint(name).id
        axis, anchor = data.xaxis[joint], data.xanchor[joint]
        body = int(model.jnt_bodyid[joint])
        behind = [b for b in range(model.nbody) if _carries(model, body, b)]
        spots = [data.xpos[b] for b in behind]
        spots += [data.geom_xpos[g] for g in range(model.ngeom) if model.geom_bodyid[g] in behind]
        shifts = [np.cross(axis, spot - anchor) for spot in spots]
        shift = max(shifts, key=lambda one: float(np.abs(one).max()))
        along = ", ".join(f"{part:.2g}" for part in axis + 0.0)
        text = (
            f"positive is a right-handed turn about its axis, which is ({along}) in the world of the MJCF "
            "where all joints are 0: the thumb of the right hand along the axis, the fingers show the way."
        )
        k = int(np.abs(shift).argmax())
        if abs(shift[k]) > _LEAST_SHIFT_M:
            text += f" What it carries then moves towards {_ENDS[int(shift[k] > 0)][k]}."
        return text

    return words


def _carries(model: Any, body: int, other: int) -> bool:
    while other > body:
        other = int(model.body_parentid[other])
    return other == body
