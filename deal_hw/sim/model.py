"""MuJoCo models of servo-driven robots: loading, joints and actuators by name."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.fields import ModelFields, element_id
from deal_hw.sim.parameters import apply_parameters
from deal_hw.types import FloatArray


BASE_COORDINATES = ("base.x", "base.y", "base.z", "base.rx", "base.ry", "base.rz")
"""Position in the world [m]; rotation vector from the reference orientation, in the base's frame [rad]."""


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A compiled MuJoCo model with the indices that follow a robot's description.

    Attributes:
        description: The robot.
        model: The nominal model; treat as read-only.
        qpos: Index into qpos of each joint, (J,).
        qvel: Index into qvel of each joint, (J,).
        actuator: Index of each actuated joint's actuator, (A,).
        base: Where the floating base's entries begin in qpos and qvel; None for a fixed base.
    """

    description: RobotDescription
    model: mujoco.MjModel
    qpos: tuple[int, ...]
    qvel: tuple[int, ...]
    actuator: tuple[int, ...]
    base: tuple[int, int] | None = None

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the C chart coordinates of a state: base position and rotation, then the joints."""
        return (BASE_COORDINATES if self.base is not None else ()) + self.description.joint_names

    @property
    def coordinate_units(self) -> tuple[str, ...]:
        """Units of the chart coordinates, (C,)."""
        base = ("m", "m", "m", "rad", "rad", "rad") if self.base is not None else ()
        return base + self.description.position_units

    @property
    def rotation(self) -> slice:
        """Which coordinates are the base's rotation vector; none of them for a fixed base."""
        return slice(3, 6) if self.base is not None else slice(0, 0)

    @property
    def joints(self) -> slice:
        """Which coordinates are joints."""
        return slice(0 if self.base is None else 6, None)

    @property
    def step_s(self) -> float:
        """Physics step [s]."""
        return float(self.model.opt.timestep)


def load_model(description: RobotDescription, step_s: float | None = None) -> RobotModel:
    """Compile a robot's MJCF and find its joints and actuators by name.

    Args:
        description: The robot.
        step_s: Physics step [s]; None for the MJCF's.

    Raises:
        ConfigurationError: The MJCF does not compile, or the device period is no multiple of the step.
        UnknownNameError: A joint of the description is not in the model.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(description.mjcf))
    except ValueError as err:
        raise ConfigurationError(f"{description.mjcf} does not compile: {err}") from err
    if step_s is not None:
        model.opt.timestep = step_s
    joints = [element_id(model, "joint", name) for name in description.joint_names]
    base = None
    if description.floating_base is not None:
        free = element_id(model, "joint", description.floating_base)
        base = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
    return RobotModel(
        description=description,
        model=model,
        qpos=tuple(int(model.jnt_qposadr[j]) for j in joints),
        qvel=tuple(int(model.jnt_dofadr[j]) for j in joints),
        actuator=tuple(element_id(model, "actuator", name) for name in description.actuated),
        base=base,
    )


def model_with(robot: RobotModel, space: ParameterSpace, theta: FloatArray) -> mujoco.MjModel:
    """Return a copy of the model with the parameters set, (K,)."""
    model = copy.copy(robot.model)
    apply_parameters(ModelFields(model, robot.model), space, np.asarray(theta, dtype=float)[None])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
