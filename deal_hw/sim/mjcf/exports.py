"""Calibrated values for other simulators: actuator tables, URDF-side values, plain YAML and BAM's JSON.

Each file lists the values that its format cannot hold, and the unidentified ones. Field names are those of
Isaac Lab's ``ActuatorBaseCfg``, ``DelayedPDActuatorCfg`` and ``DCMotorCfg``, of mjlab's
``BuiltinPositionActuatorCfg`` and ``DcMotorActuatorCfg`` (1.6), and of URDF.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import Parameter
from deal_hw.sim.engine.batch import COMMAND_KINDS
from deal_hw.sim.engine.model import RobotModel, model_with
from deal_hw.sim.mjcf.bam import BAM, bam_parameters, drive_texts, parameter_texts
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.parameters.followers import Follower
from deal_hw.sim.parameters.inertia import INERTIA_KINDS
from deal_hw.sim.parameters.laws import FREE_SPEED, LAW_KINDS
from deal_hw.sim.parameters.transmission import TRANSMISSION_KINDS

ACTUATORS = "actuators.yaml"
URDF = "urdf.yaml"
VALUES = "values.yaml"

_ACTUATOR_KINDS: Mapping[str, str] = {
    "servo_stiffness": "stiffness",
    "servo_damping": "damping",
    "dof_damping": "damping",
    "dof_armature": "armature",
    "dof_frictionloss": "friction",
    "servo_effort_limit": "effort_limit",
    "servo_speed_limit": "velocity_limit",
    "command_delay": "delay_s",
}
"""Kind of parameter -> column of the actuator table."""
_MOTOR_KINDS = {**_ACTUATOR_KINDS, FREE_SPEED: "velocity_limit"}
"""The same for the tables of motors, whose effort falls with speed."""
_URDF_KINDS = ("dof_damping", "dof_frictionloss", "servo_effort_limit", "rod_length")
"""Kinds with a field in URDF, beside those of bodies' masses and inertias."""
_BODY_KINDS = (
    "body_mass",
    "body_inertia",
    "body_ipos_x",
    "body_ipos_y",
    "body_ipos_z",
    "rod_length",
    *(kind.name for kind in INERTIA_KINDS),
)

_ISAAC_LAB = (
    "damping is the servo's D gain and the joint's own damping together: the table has one field. The "
    "joint's own is not clipped by effort_limit in the calibrated model",
    "friction is dry friction [N*m or N]; Isaac Sim before 5.0 takes a coefficient without unit there",
    "velocity_limit bounds the set-point's speed in the calibrated model, the joint's in Isaac Lab",
    "min_delay and max_delay are whole physics steps, of the 90 % interval of the latency; delay_s is the "
    "value",
)
_MJLAB = (
    "velocity_limit has no field: no set-point is limited in speed",
    "delay_min_lag and delay_max_lag are both the latency in whole physics steps, because mjlab draws from "
    "a range at each step",
)
_ISAAC_LAB_MOTORS = (
    "the delay has no field: DCMotorCfg has none",
    "back-EMF brakes faster than velocity_limit in the calibrated model, there only up to effort_limit",
)
_MJLAB_MOTORS = (
    "back-EMF brakes faster than velocity_limit in the calibrated model, there only up to effort_limit",
)
_URDF = (
    "armature has no field: most importers set 0",
    "stiffness, the servo's D gain and delays have no field: they go into the controller's settings",
    "damping is the joint's and its actuator's alone",
    "contact friction and restitution have no field",
)


def write_exports(
    folder: Path, robot: RobotModel, result: CalibrationResult, judged: Mapping[str, Any] | None = None
) -> list[str]:
    """Write the values for other programs into a folder; return the files' names.

    Args:
        folder: Folder to write to.
        robot: The nominal model.
        result: The result.
        judged: What to put behind the format of each file: the verdict on the result; plain values.
    """
    tables = {
        ACTUATORS: actuator_tables(robot, result),
        URDF: urdf_values(robot, result),
        VALUES: plain_values(result),
    }
    tables[BAM] = bam_parameters(robot, result)
    for name, values in tables.items():
        marked = {"format": values["format"], **(judged or {}), **_marks(result), **values}
        if name == BAM:
            text = json.dumps(marked, indent=2, ensure_ascii=False) + "\n"
        else:
            text = yaml.safe_dump(marked, sort_keys=False, width=110)
        (folder / name).write_text(text, encoding="utf-8")
    return list(tables)


def _marks(result: CalibrationResult) -> dict[str, Any]:
    """Return the reasons to distrust the values: what each alarm saw, and biased values with their causes."""
    return {"alarms": [alarm.seen for alarm in result.alarms], "biased": dict(result.biased)}


def actuator_tables(robot: RobotModel, result: CalibrationResult) -> dict[str, Any]:
    """Return the actuators of the calibrated model in the formats of Isaac Lab and mjlab.

    A motor that takes efforts has no gains: it is not in Isaac Lab's columns, and mjlab's fields are None.
    Values are at the joint, gears included. Servos whose effort falls with speed stand a second time, under
    ``isaac_lab_motors`` and ``mjlab_motors``: as the classes that have that law.
    """
    model = model_with(robot, result.space, result.estimate)
    rows = {
        joint: _actuator(robot, model, result, number)
        for number, joint in enumerate(robot.description.actuated)
    }
    columns = ("stiffness", "damping", "armature", "friction", "effort_limit", "velocity_limit")
    low, high = result.latency_interval_s
    steps = {"min": math.floor(max(low, 0.0) / robot.step_s), "max": math.ceil(max(high, 0.0) / robot.step_s)}
    # A joint that is not named keeps the values of its USD.
    isaac = {
        column: {joint: row[column] for joint, row in rows.items() if row[column] is not None}
        for column in columns
    }
    for joint in isaac["damping"]:
        isaac["damping"][joint] += rows[joint]["joint_damping"]
    motors = {joint: row for joint, row in rows.items() if row["free_speed"] and row["effort_limit"]}
    drives = [
        text
        for number, drive in enumerate(dataclasses.replace(robot, model=model).drives)
        for text in (drive_texts(result, drive, robot.actuator_names[number]) if drive is not None else ())
    ]
    lost, motors_lost = (drives + _left_out(result, kinds) for kinds in (_ACTUATOR_KINDS, _MOTOR_KINDS))
    blind = [result.space[name] for name in result.without_value]
    unidentified = {
        joint: [
            _ACTUATOR_KINDS[p.kind] for p in blind if p.kind in _ACTUATOR_KINDS and _drives(robot, p, number)
        ]
        for number, joint in enumerate(robot.description.actuated)
    }
    return {
        "format": "deal_hw.actuators/1",
        "physics_step_s": robot.step_s,
        "delay_s": {joint: row["delay_s"] for joint, row in rows.items()},
        "without_value": {joint: names for joint, names in unidentified.items() if names},
        "isaac_lab": {
            "class": "DelayedPDActuatorCfg",
            "joint_names_expr": list(rows),
            **isaac,
            "min_delay": steps["min"],
            "max_delay": steps["max"],
            "cannot_express": [*_ISAAC_LAB, *lost],
        },
        "mjlab": {
            "class": "BuiltinPositionActuatorCfg",
            "actuators": [_mjlab(joint, row, robot.step_s) for joint, row in rows.items()],
            "cannot_express": [*_MJLAB, *lost],
        },
        **_section(
            "isaac_lab_motors",
            "DCMotorCfg",
            [
                {
                    "joint_names_expr": [joint],
                    "stiffness": row["stiffness"],
                    "damping": row["damping"] + row["joint_damping"],
                    "armature": row["armature"],
                    "friction": row["friction"],
                    "effort_limit": row["effort_limit"],
                    "saturation_effort": row["effort_limit"],
                    "velocity_limit": row["free_speed"],
                }
                for joint, row in motors.items()
            ],
            [*_ISAAC_LAB[:2], *_ISAAC_LAB_MOTORS, *motors_lost],
        ),
        **_section(
            "mjlab_motors",
            "DcMotorActuatorCfg",
            [
                _mjlab(joint, row, robot.step_s)
                | {"saturation_effort": row["effort_limit"], "velocity_limit": row["free_speed"]}
                for joint, row in motors.items()
            ],
            [_MJLAB[1], *_MJLAB_MOTORS, *motors_lost],
        ),
    }


def _section(place: str, name: str, actuators: list[dict[str, Any]], lost: list[str]) -> dict[str, Any]:
    """Return the table of servos whose effort falls with speed, under its place; none without such."""
    return {place: {"class": name, "actuators": actuators, "cannot_express": lost}} if actuators else {}


def _mjlab(joint: str, row: Mapping[str, Any], step_s: float) -> dict[str, Any]:
    return {
        "target_names_expr": [joint],
        "stiffness": row["stiffness"],
        "damping": row["damping"],
        "effort_limit": row["effort_limit"],
        "armature": row["armature"],
        "frictionloss": row["friction"],
        "viscous_damping": row["joint_damping"],
        **dict.fromkeys(("delay_min_lag", "delay_max_lag"), round(row["delay_s"] / step_s)),
    }


def urdf_values(robot: RobotModel, result: CalibrationResult) -> dict[str, Any]:
    """Return the calibrated model's values for a URDF: joints, and links with calibrated masses."""
    model = model_with(robot, result.space, result.estimate)
    description = robot.description
    joints: dict[str, Any] = {}
    for joint, qvel in zip(description.joint_names, robot.qvel, strict=True):
        index = int(model.dof_jntid[qvel])
        damping, friction = float(model.dof_damping[qvel]), float(model.dof_frictionloss[qvel])
        limit: dict[str, float | None] = {"lower": None, "upper": None, "effort": None, "velocity": None}
        if model.jnt_limited[index]:
            limit["lower"], limit["upper"] = map(float, model.jnt_range[index])
        if joint in description.actuated:
            row = _actuator(robot, model, result, description.actuated.index(joint))
            limit["effort"], damping = row["effort_limit"], row["joint_damping"]
        joints[joint] = {"dynamics": {"damping": damping, "friction": friction}, "limit": limit}
    for follower in robot.followers:
        if follower.leader >= 0 and not follower.coefficients[2:].any():
            joints[model.joint(follower.joint).name] = {"mimic": _mimic(model, follower)}
    moved = [p for p in robot.acting(result.space).parameters if p.kind in _BODY_KINDS]
    bodies = dict.fromkeys(name for parameter in moved for name in parameter.elements)
    return {
        "format": "deal_hw.urdf/1",
        "joints": joints,
        "links": {name: _inertial(model, element_id(model, "body", name)) for name in bodies},
        "without_value": list(result.without_value),
        "cannot_express": [*_URDF, *_left_out(result, (*_URDF_KINDS, *_BODY_KINDS))],
    }


def _mimic(model: Any, follower: Follower) -> dict[str, Any]:
    """Return a URDF's ``<mimic>`` of a joint, whose positions count from those of the model."""
    constant, slope = map(float, follower.coefficients[:2])
    own, led = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (follower.joint, follower.leader))
    leader = model.joint(follower.leader).name
    return {"joint": leader, "multiplier": slope, "offset": own + constant - slope * led}


def plain_values(result: CalibrationResult) -> dict[str, Any]:
    """Return each value with its unit and 90 % interval; None for an unidentified value."""
    values: dict[str, Any] = {}
    for parameter, estimate, (low, high) in zip(result.space, result.estimate, result.interval, strict=True):
        has = parameter.name not in result.without_value
        values[parameter.name] = {
            "kind": parameter.kind,
            "elements": list(parameter.elements),
            "unit": parameter.unit,
            "value": float(estimate) if has else None,
            "interval": [float(low), float(high)],
            "nominal": parameter.nominal,
            "biased_by": result.biased.get(parameter.name),
        }
    low, high = result.latency_interval_s
    return {
        "format": "deal_hw.values/1",
        "parameters": values,
        "known": {name: float(value) for name, value in result.space.known.items()},
        "latency": {"unit": "s", "value": float(result.latency_s), "interval": [float(low), float(high)]},
        "cannot_express": ["how values depend on each other: distribution.json has their covariance"],
    }


def laws_without_a_field(result: CalibrationResult) -> list[str]:
    """Return the names of calibrated laws that neither Isaac Lab, nor mjlab, nor a URDF can express."""
    laws = (*LAW_KINDS, *TRANSMISSION_KINDS)
    kinds = {*(kind.name for kind in laws), *COMMAND_KINDS} - {FREE_SPEED}
    return [p.name for p in result.space.parameters if p.kind in kinds]


def _actuator(robot: RobotModel, model: Any, result: CalibrationResult, number: int) -> dict[str, Any]:
    """Return one actuator's values at its joint, in SI."""
    actuator = robot.actuator[number]
    joint = robot.description.joint_names.index(robot.description.actuated[number])
    dof, gear = robot.qvel[joint], abs(float(model.actuator_gear[actuator, 0]))
    drive = drive_of(model, actuator, robot.actuator_names[number])
    servo = drive.takes == "position"
    effort = None
    if model.actuator_forcelimited[actuator]:
        effort = float(np.abs(model.actuator_forcerange[actuator]).max()) * gear
    elif not servo and model.actuator_ctrllimited[actuator]:
        effort = float(np.abs(model.actuator_ctrlrange[actuator]).max()) * abs(drive.gain)
    # A motor's own damping is passive: it acts beside efforts, as the joint's.
    passive = 0.0 if drive.takes != "effort" else drive.damping
    gains = {"position": (drive.stiffness, drive.damping), "velocity": (0.0, drive.damping)}
    stiffness, damping = gains.get(drive.takes, (None, None))
    return {
        "stiffness": stiffness,
        "damping": damping,
        # MuJoCo adds those of the actuator to those of the joint.
        "joint_damping": float(model.dof_damping[dof] + gear**2 * model.actuator_damping[actuator]) + passive,
        "armature": float(model.dof_armature[dof] + gear**2 * model.actuator_armature[actuator]),
        "friction": float(model.dof_frictionloss[dof]),
        "effort_limit": effort,
        "velocity_limit": _device_value(robot, result, "servo_speed_limit", number),
        "free_speed": _device_value(robot, result, FREE_SPEED, number) if servo else None,
        "delay_s": float(result.latency_s)
        + (_device_value(robot, result, "command_delay", number) or float(robot.command_delay_s[number])),
    }


def _device_value(robot: RobotModel, result: CalibrationResult, kind: str, number: int) -> float | None:
    """Return an actuator's value without a MuJoCo field; None if unknown."""
    values = dict(zip(result.space.names, result.estimate, strict=True)) | result.space.known
    for parameter in result.space.parameters:
        if parameter.kind == kind and _drives(robot, parameter, number):
            return float(values[parameter.name])
    limit = robot.description.speed_limit[number] if kind == "servo_speed_limit" else math.inf
    return float(limit) if math.isfinite(limit) else None


def _drives(robot: RobotModel, parameter: Parameter, number: int) -> bool:
    names = (
        {robot.actuator_names[number]}
        if parameter.kind.startswith(("servo_", "command_", "motor_"))
        else set()
    )
    return bool((names or {robot.description.actuated[number]}) & set(parameter.elements))


def _inertial(model: Any, body: int) -> dict[str, Any]:
    """Return mass, centre of mass and inertia of a link, in the link's frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    axes = rotation.reshape(3, 3)
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    entries = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    return {
        "mass": float(model.body_mass[body]),
        "origin_xyz": [float(v) for v in model.body_ipos[body]],
        "inertia": {name: float(inertia[row, column]) for name, row, column in entries},
    }


def _left_out(result: CalibrationResult, kinds: Sequence[str] | Mapping[str, str]) -> list[str]:
    """Return the calibrated parameters without a field in a format, with their values."""
    return [text for kind, text in parameter_texts(result) if kind not in kinds]
