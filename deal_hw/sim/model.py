"""MuJoCo models of servo-driven robots: loading, joints and actuators by name, calibrated MJCF."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.fields import Array, ModelFields, element_id
from deal_hw.sim.parameters import apply_parameters, check_kinds
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A compiled MuJoCo model with the indices that follow a robot's description.

    Attributes:
        description: The robot.
        model: The nominal model; treat as read-only.
        qpos: Index into qpos of each joint, (J,).
        qvel: Index into qvel of each joint, (J,).
        actuator: Index of each actuated joint's actuator, (A,).
    """

    description: RobotDescription
    model: mujoco.MjModel
    qpos: tuple[int, ...]
    qvel: tuple[int, ...]
    actuator: tuple[int, ...]

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
    return RobotModel(
        description=description,
        model=model,
        qpos=tuple(int(model.jnt_qposadr[j]) for j in joints),
        qvel=tuple(int(model.jnt_dofadr[j]) for j in joints),
        actuator=tuple(element_id(model, "actuator", name) for name in description.actuated),
    )


def model_with(robot: RobotModel, space: ParameterSpace, theta: FloatArray) -> mujoco.MjModel:
    """Return a copy of the model with the parameters set, (K,)."""
    model = copy.copy(robot.model)
    apply_parameters(ModelFields(model, robot.model), space, np.asarray(theta, dtype=float)[None])
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


SPEED_LIMIT_NUMERIC = "deal_hw.speed_limit"
LATENCY_NUMERIC = "deal_hw.latency_s"


def write_calibrated_mjcf(
    robot: RobotModel, space: ParameterSpace, theta: FloatArray, path: Path, latency_s: float
) -> None:
    """Write the robot's MJCF with calibrated values.

    What MuJoCo has no field for goes into ``<custom>``: the servo's speed limit and the latency.

    Args:
        robot: The robot's model.
        space: The parameters.
        theta: Calibrated values, (K,).
        path: File to write.
        latency_s: Total latency [s].

    Raises:
        ConfigurationError: The written file does not compile to the calibrated values.
    """
    check_kinds(space)
    spec = mujoco.MjSpec.from_file(str(robot.description.mjcf))
    wanted = model_with(robot, space, theta)
    for body in spec.bodies[1:]:
        i = element_id(wanted, "body", body.name)
        body.mass, body.inertia, body.ipos = wanted.body_mass[i], wanted.body_inertia[i], wanted.body_ipos[i]
    for joint in spec.joints:
        dof = int(wanted.jnt_dofadr[element_id(wanted, "joint", joint.name)])
        joint.armature, joint.frictionloss = wanted.dof_armature[dof], wanted.dof_frictionloss[dof]
        damping = np.atleast_1d(np.array(joint.damping, dtype=float))
        damping[0] = np.ravel(wanted.dof_damping[dof])[0]
        joint.damping = damping if np.ndim(joint.damping) else float(damping[0])
    for actuator in spec.actuators:
        i = element_id(wanted, "actuator", actuator.name)
        actuator.gainprm, actuator.biasprm = wanted.actuator_gainprm[i], wanted.actuator_biasprm[i]
        actuator.forcerange = wanted.actuator_forcerange[i]
    values = dict(zip(space.names, np.asarray(theta, dtype=float), strict=True)) | space.known
    speeds = [values[p.name] for p in space.parameters if p.kind == "servo_speed_limit"]
    for name, data in ((SPEED_LIMIT_NUMERIC, speeds), (LATENCY_NUMERIC, [latency_s])):
        if data:
            spec.add_numeric(name=name, data=data, size=len(data))
    spec.compile()
    path.write_text(spec.to_xml(), encoding="utf-8")
    _check_written(path, wanted)


def _check_written(path: Path, wanted: mujoco.MjModel) -> None:
    written = mujoco.MjModel.from_xml_path(str(path))
    for field in (
        "body_mass", "body_inertia", "body_ipos", "dof_armature", "dof_damping", "dof_frictionloss",
        "actuator_gainprm", "actuator_biasprm", "actuator_forcerange",
    ):  # fmt: skip
        have: Array = getattr(written, field)
        want: Array = getattr(wanted, field)
        if not np.allclose(have, want, rtol=1e-4, atol=1e-12):
            raise ConfigurationError(f"{path}: {field} came out as {have.tolist()}, expected {want.tolist()}")
