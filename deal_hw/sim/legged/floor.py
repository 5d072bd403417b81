"""A robot whose model hangs in the air, set on a floor: its base is free, and its feet bear it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.model import RobotModel, robot_model
from deal_hw.sim.parameters.fields import element_id

BASE: Final = "base"
"""Name of the free joint."""
FLOOR: Final = "floor"
FRICTION: Final = (0.8, 0.02, 0.01)
"""Sliding, turning and rolling friction of the floor, as in the Go2's model."""


def on_floor(robot: RobotModel, feet: Sequence[str]) -> RobotModel:
    """Return the model of a robot that stands on a floor in its default pose.

    Only the named geoms touch the floor, and nothing touches itself. The lowest point of the feet is at the
    floor.

    Args:
        robot: The robot; its description has a fixed base.
        feet: Geoms of the feet.

    Raises:
        ConfigurationError: The base is free already, or the model has more than one body at its top.
        UnknownNameError: The model has no such geom.
    """
    name = robot.description.name
    spec: Any = mujoco.MjSpec.from_file(str(robot.description.mjcf))
    trunks = spec.worldbody.bodies
    if robot.base is not None or len(trunks) != 1:
        raise ConfigurationError(
            f"the model of {name!r} has {len(trunks)} bodies at its top and "
            f"{'a fixed' if robot.base is None else 'a free'} base; to be set on a floor it needs one body "
            "with a fixed base"
        )
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.timestep = robot.step_s
    for foot in feet:
        element_id(robot.model, "geom", foot)
    for geom in spec.geoms:
        geom.contype, geom.conaffinity = int(geom.name in feet), 0
    spec.worldbody.add_geom(
        name=FLOOR,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.05],
        contype=0,
        conaffinity=1,
        condim=3,
        priority=1,
        friction=FRICTION,
    )
    trunks[0].add_freejoint(name=BASE)
    trunks[0].pos[2] -= _lowest(robot, feet)
    return robot_model(dataclasses.replace(robot.description, floating_base=BASE), spec.compile())


def _lowest(robot: RobotModel, feet: Sequence[str]) -> float:
    """Return the height of the feet's lowest point in the default pose [m], by their bounding boxes."""
    model, data = robot.model, mujoco.MjData(robot.model)
    robot.place(data.qpos, np.array(robot.description.default_position))
    mujoco.mj_kinematics(model, data)
    found = []
    for foot in feet:
        index = element_id(model, "geom", foot)
        middle, half = model.geom_aabb[index].reshape(2, 3)
        up = data.geom_xmat[index].reshape(3, 3)[2]
        found.append(data.geom_xpos[index, 2] + up @ middle - np.abs(up) @ half)
    return float(min(found))
