"""Tests whether a simulated robot holds its start pose, which fails with wrong gains or a long timestep."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from deal_hw.sim.engine.compiling import DIVERGED
from deal_hw.sim.engine.model import actuator_of, command_scale
from deal_hw.sim.robots.user_robot import UserRobot
from deal_hw.types import FloatArray

SECONDS: Final = 1.0
"""Length [s]."""
UNSTABLE_GROWTH: Final = 1.5
"""Ratio of the speeds in the last and the second quarter above which a driven joint is unstable."""
LEAST_SPEED: Final = 0.05
"""Least speed of an unstable joint [rad/s or m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Holding:
    """Result of the test.

    Attributes:
        seconds: Simulated time [s].
        diverged: Whether the simulation diverged.
        unstable: Driven joints whose speed grows.
        sag: Distance of each driven joint from its start pose at the end, (A,) [rad or m].
        speed: Root mean square of each driven joint's speed in the last quarter, (A,) [rad/s or m/s].
    """

    seconds: float
    diverged: bool
    unstable: tuple[str, ...]
    sag: FloatArray
    speed: FloatArray


def hold(robot: UserRobot) -> Holding:
    """Simulate a robot that is commanded to hold its start pose; motors get no effort."""
    model: Any = copy.copy(robot.model)
    # A command that is held acts at once: MuJoCo begins with commands of 0 before.
    model.actuator_delay[:] = 0.0
    description = robot.description()
    data = mujoco.MjData(model)
    driven = [model.joint(name) for name in description.actuated]
    for name, position in zip(description.joint_names, description.default_position, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = position
    start = np.array([description.default_position[i] for i in description.actuated_index])
    scale = command_scale(model, range(model.nu))
    rest = description.held(np.array(description.default_position))
    for name, held in zip(description.actuated, rest, strict=True):
        actuator = actuator_of(model, name)
        data.ctrl[actuator] = held / scale[actuator]
    at, moving = [int(j.qposadr[0]) for j in driven], [int(j.dofadr[0]) for j in driven]
    steps = max(round(SECONDS / model.opt.timestep), 4)
    speed = np.empty((steps, len(driven)))
    for step in range(steps):
        mujoco.mj_step(model, data)
        speed[step] = data.qvel[moving]
    # After a divergence MuJoCo restarts from the reference pose: only the warning remains.
    diverged = any(data.warning[getattr(mujoco.mjtWarning, name)].number for name in DIVERGED)
    quarter = steps // 4
    second, last = (
        np.sqrt(np.mean(np.square(speed[a : a + quarter]), axis=0)) for a in (quarter, steps - quarter)
    )
    grows = (last > UNSTABLE_GROWTH * second) & (last > LEAST_SPEED)
    grows &= np.array(description.servos, dtype=bool)
    return Holding(
        seconds=steps * float(model.opt.timestep),
        diverged=diverged,
        unstable=tuple(name for name, found in zip(description.actuated, grows, strict=True) if found),
        sag=np.asarray(data.qpos[at] - start),
        speed=last,
    )
