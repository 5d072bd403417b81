"""MuJoCo models of servo-driven robots: loading, joints and actuators by name."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.laws.commands import Filters
from deal_hw.sim.parameters import apply_parameters, present
from deal_hw.sim.parameters.drive import JointDrive, filtered, find_drive
from deal_hw.sim.parameters.fields import ModelFields, element_id, element_names
from deal_hw.sim.parameters.followers import Follower, followers_of
from deal_hw.sim.parameters.kind import joint_of
from deal_hw.sim.parameters.one_drive import brakes, gather
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
        actuator: Index of the actuator that drives each actuated joint, (A,).
        base: Where the floating base's entries begin in qpos and qvel; None for a fixed base.
        setups: The robot in other set-ups, such as with a payload, by their names.
        absent: Type and name of elements that other set-ups have, and this model lacks.
        own: Names of the set-ups whose own parameters act here.
        followers: Joints that follow those of the description by an equality of the model.
    """

    description: RobotDescription
    model: mujoco.MjModel
    qpos: tuple[int, ...]
    qvel: tuple[int, ...]
    actuator: tuple[int, ...]
    base: tuple[int, int] | None = None
    setups: Mapping[str, RobotModel] = field(default_factory=dict)
    absent: frozenset[tuple[str, str]] = frozenset()
    own: frozenset[str] = frozenset()
    followers: tuple[Follower, ...] = ()

    def in_setup(self, name: str) -> RobotModel:
        """Return the robot in a set-up; "" is the model itself."""
        return self.setups[name] if name else self

    def acting(self, space: ParameterSpace) -> ParameterSpace:
        """Return the parameters, those that act on this model with their elements, the others with none."""
        return present(space, self.absent, self.own)

    def place(
        self,
        qpos: FloatArray,
        position: FloatArray,
        qvel: FloatArray | None = None,
        velocity: FloatArray | None = None,
    ) -> None:
        """Write positions of the joints, (..., J), into (..., nq), with those of joints that follow them.

        Args:
            qpos: Where to write.
            position: Positions of the joints [rad or m].
            qvel: Where to write speeds, (..., nv); None: none are written.
            velocity: Speeds of the joints, (..., J).
        """
        qpos[..., list(self.qpos)] = position
        if qvel is not None:
            qvel[..., list(self.qvel)] = velocity
        for follower in self.followers:
            follower.follow(self.model, qpos, qvel)
        # A ball joint has no reading: it begins at rest in the model's pose.
        for ball in np.flatnonzero(self.model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)):
            at, dof = int(self.model.jnt_qposadr[ball]), int(self.model.jnt_dofadr[ball])
            qpos[..., at : at + 4] = self.model.qpos0[at : at + 4]
            if qvel is not None:
                qvel[..., dof : dof + 3] = 0.0

    @property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of the actuators in the order of the actuated joints, (A,)."""
        names = element_names(self.model, "actuator")
        return tuple(names[i] for i in self.actuator)

    @property
    def drives(self) -> tuple[JointDrive | None, ...]:
        """What each of these actuators does, (A,); None for one that is none of the known drives."""
        return tuple(find_drive(self.model, i) for i in self.actuator)

    @property
    def filters(self) -> Filters | None:
        """The filters of the actuators' commands, in the commands' units; None without any."""
        if not any(filtered(self.model, i) for i in self.actuator):
            return None
        return filters_of(self.model, self.actuator, self.command_scale)

    @property
    def latency_s(self) -> float:
        """Latency of the MJCF, the least delay of its actuators [s]: where a search of the latency begins."""
        return float(min(self.model.actuator_delay[list(self.actuator)], default=0.0))

    @property
    def command_delay_s(self) -> FloatArray:
        """Delay of each actuator's commands in the MJCF beyond that latency, (A,) [s]."""
        return np.asarray(self.model.actuator_delay[list(self.actuator)] - self.latency_s)

    @property
    def command_scale(self) -> FloatArray:
        """A command of each actuator, set-point of the joint or ``ctrl`` of a motor, over ``ctrl``, (A,)."""
        return command_scale(self.model, self.actuator)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the C tangent coordinates of a state: base position and rotation, then the joints."""
        return (BASE_COORDINATES if self.base is not None else ()) + self.description.joint_names

    @property
    def coordinate_units(self) -> tuple[str, ...]:
        """Units of the tangent coordinates, (C,)."""
        base = ("m", "m", "m", "rad", "rad", "rad") if self.base is not None else ()
        return base + self.description.position_units

    @property
    def rotation(self) -> slice:
        """Coordinates of the base's rotation vector; empty for a fixed base."""
        return slice(3, 6) if self.base is not None else slice(0, 0)

    @property
    def joints(self) -> slice:
        """Coordinates of the joints."""
        return slice(0 if self.base is None else 6, None)

    @property
    def step_s(self) -> float:
        """Physics step [s]."""
        return float(self.model.opt.timestep)


def load_model(description: RobotDescription, step_s: float | None = None) -> RobotModel:
    """Compile a robot's MJCF and find its joints and actuators by name.

    Args:
        description: The robot.
        step_s: Physics step [s]; None for the MJCF's, or for the device period if that is no multiple of it.

    Raises:
        ConfigurationError: The MJCF does not compile, or the device period is no multiple of the step.
        UnknownNameError: A joint of the description is not in the model.
    """
    model = compile_mjcf(description.mjcf)
    if step_s is None:
        # Two robots may share an MJCF whose step fits only one of them.
        steps = 1.0 / (description.device_rate_hz * model.opt.timestep)
        step_s = model.opt.timestep if abs(steps - round(steps)) < 1e-6 else 1.0 / description.device_rate_hz
    model.opt.timestep = step_s
    return robot_model(description, model)


def robot_model(description: RobotDescription, model: mujoco.MjModel) -> RobotModel:
    """Return a compiled model with the indices of a robot's joints, actuators and base, found by name.

    Its drives are gathered in place (:mod:`deal_hw.sim.parameters.one_drive`).

    Raises:
        ConfigurationError: No actuator drives an actuated joint, or several do.
        UnknownNameError: A joint of the description is not in the model.
    """
    gather(model)
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
        actuator=tuple(actuator_of(model, name) for name in description.actuated),
        base=base,
        followers=followers_of(model, joints),
    )


def actuator_of(model: mujoco.MjModel, joint: str) -> int:
    """Return the id of the actuator that drives a joint, whatever the actuator's own name.

    Raises:
        UnknownNameError: There is no such joint.
        ConfigurationError: No actuator drives it, or several do.
    """
    index = element_id(model, "joint", joint)
    idle = brakes(model)
    found = [i for i in range(model.nu) if joint_of(model, i) == index and i not in idle]
    if len(found) == 1:
        return found[0]
    names = element_names(model, "actuator")
    if not found:
        raise ConfigurationError(
            f"no actuator of the model drives joint {joint!r}; actuators: {', '.join(names) or '(none)'}. "
            f'Give it one in the MJCF, such as <position joint="{joint}" kp="..."/>'
        )
    raise ConfigurationError(
        f"actuators {', '.join(names[i] or f'number {i}' for i in found)} all drive joint {joint!r}; "
        "keep the one that takes the recorded commands. A <position> and a <velocity> are one drive if "
        "neither has a forcerange, a filter or a delay of its own: write the limit as actuatorfrcrange of "
        "the joint"
    )


def command_scale(model: mujoco.MjModel, actuators: Sequence[int]) -> FloatArray:
    """Return what one unit of ``ctrl`` of servos is as set-point of their joints, (A,); 1 for others."""
    drives = [find_drive(model, i) for i in actuators]
    return np.array([d.scale if d is not None and d.takes == "position" else 1.0 for d in drives])


def filters_of(model: mujoco.MjModel, actuators: Sequence[int], scale: FloatArray) -> Filters:
    """Return the filters of actuators as laws of commands.

    Args:
        model: The model as in its file.
        actuators: The actuators, A of them.
        scale: From :func:`command_scale`.
    """
    # With their types, since a model may have no actuator.
    rows = np.array(actuators, dtype=np.int64)
    on = np.array([filtered(model, int(i)) for i in rows], dtype=bool)
    limited = on & np.array(model.actuator_ctrllimited[rows], dtype=bool)
    ends = np.sort(model.actuator_ctrlrange[rows] * scale[:, None], axis=1)
    return Filters(
        lag_s=np.where(on, np.maximum(model.actuator_dynprm[rows, 0], 0.0), 0.0),
        euler=model.actuator_dyntype[rows] == int(mujoco.mjtDyn.mjDYN_FILTER),
        late=on & ~np.array(model.actuator_actearly[rows], dtype=bool),
        low=np.where(limited, ends[:, 0], -np.inf),
        high=np.where(limited, ends[:, 1], np.inf),
    )


def drop_command_laws(model: mujoco.MjModel) -> None:
    """Remove filters and delays of a model's actuators, for an engine whose commands pass laws before."""
    model.actuator_delay[:] = 0.0
    for actuator in range(model.nu):
        if filtered(model, actuator):
            model.actuator_dyntype[actuator] = int(mujoco.mjtDyn.mjDYN_NONE)
            model.actuator_actadr[actuator], model.actuator_actnum[actuator] = -1, 0


def at_step(robot: RobotModel, step_s: float) -> RobotModel:
    """Return the robot with another physics step [s]."""
    model = copy.copy(robot.model)
    model.opt.timestep = step_s
    setups = {name: at_step(setup, step_s) for name, setup in robot.setups.items()}
    return dataclasses.replace(robot, model=model, setups=setups)


def fitted_step(period_s: float, step_s: float) -> float:
    """Return the physics step near a wanted one of which a device period has a whole number [s].

    Args:
        period_s: The device period [s].
        step_s: The wanted step [s].
    """
    steps = max(round(period_s / step_s), 1)
    return step_s if abs(period_s / step_s - steps) < 1e-6 else period_s / steps


def model_with(robot: RobotModel, space: ParameterSpace, theta: FloatArray) -> mujoco.MjModel:
    """Return a copy of the model with the parameters set, (K,)."""
    model = copy.copy(robot.model)
    apply_parameters(
        ModelFields(model, robot.model), robot.acting(space), np.asarray(theta, dtype=float)[None]
    )
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def model_digest(robot: RobotModel) -> str:
    """Return the SHA-256 of the nominal model's compiled form, meshes and physics step included."""
    buffer = np.empty(mujoco.mj_sizeModel(robot.model), dtype=np.uint8)
    mujoco.mj_saveModel(robot.model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
