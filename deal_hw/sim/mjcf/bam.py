"""Calibrated servos as parameters of BAM (https://github.com/Rhoban/bam): friction law and motor.

BAM's servo is a motor on a voltage: ``torque = kt U / R - kt² w / R`` with ``U = vin duty`` and
``duty = clip(kp error_gain (target - q), +-max_pwm)``. Its friction m1 to m5 is the law of
:mod:`deal_hw.sim.laws.friction`: m1 Coulomb, m2 Stribeck, m3 by load, m4 both, m5 with directions.

Any voltage gives the same torque, with other kt and R. The voltage here is that of BAM's class mx64, a servo
that is this motor and nothing else: an entry can be loaded without the type of the real servo.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import Parameter
from deal_hw.sim.engine.model import RobotModel, model_with
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.drive import JointDrive, drive_of
from deal_hw.sim.parameters.laws import FREE_SPEED, FRICTION_KINDS, STRIBECK_SPEED

BAM = "bam.json"
"""Name of the file in a result's folder."""
SERVO: Mapping[str, float] = {"vin": 15.0, "error_gain": 0.158, "max_pwm": 0.9625}
"""Constants of BAM's class mx64 (commit 039bf23b, bam/dynamixel/actuator.py): supply [V], duty in 1 of the
firmware's gain and 1 rad, largest duty."""
EXPONENT = 2.0
"""BAM's alpha in our law of Stribeck friction."""

_KINDS = (
    *FRICTION_KINDS,
    FREE_SPEED,
    "servo_stiffness",
    "servo_damping",
    "servo_effort_limit",
    "servo_speed_limit",
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
    "command_delay",
)


def bam_parameters(robot: RobotModel, result: CalibrationResult) -> dict[str, Any]:
    """Return every servo joint as BAM's parameters, with what is lost, and the joints that cannot be one.

    Args:
        robot: The nominal model.
        result: The result.
    """
    model = model_with(robot, result.space, result.estimate)
    joints: dict[str, Any] = {}
    left_out: dict[str, str] = {}
    for number, joint in enumerate(robot.description.actuated):
        found = _servo(robot, model, result, number)
        if isinstance(found, str):
            left_out[joint] = found
        else:
            joints[joint] = found
    return {"format": "deal_hw.bam/1", "joints": joints, "left_out": left_out}


def _servo(robot: RobotModel, model: Any, result: CalibrationResult, number: int) -> dict[str, Any] | str:
    """Return one joint's entry, or why it has none."""
    name, joint = robot.actuator_names[number], robot.description.actuated[number]
    drive = drive_of(model, robot.actuator[number], name)
    if drive.takes != "position":
        return "its actuator takes no set-points of the position, as BAM's servo does"
    named = {"actuator": name, "joint": joint}
    own = [p for p in result.space.parameters if named.get(KIND_TABLE[p.kind].element) in p.elements]
    numbers = dict(zip(result.space.names, result.estimate, strict=True)) | result.space.known
    values = {p.kind: float(numbers[p.name]) for p in own}
    if not math.isfinite(drive.effort_limit):
        return "no effort limit is known (forcerange), so no torque at standstill"
    free_speed = values.get(FREE_SPEED)
    if free_speed is None and drive.damping <= 0:
        return "neither motor_free_speed nor a servo damping is known, so no back-EMF"
    lost = [text for p, text in parameter_texts(result, own) if p not in _KINDS]
    lost += drive_texts(result, drive, name)
    if free_speed is None:
        free_speed = drive.effort_limit / drive.damping
        lost.append(
            "the servo damping is taken as the motor's back-EMF: here the effort limit falls with speed, in "
            "the calibrated model it does not"
        )
    volts = SERVO["vin"] * SERVO["max_pwm"]
    kt = volts / free_speed
    resistance = kt * volts / drive.effort_limit
    dof = robot.qvel[robot.description.joint_names.index(joint)]
    actuator, gear = robot.actuator[number], drive.gear**2
    viscous = float(model.dof_damping[dof] + gear * model.actuator_damping[actuator])
    # Below the limit the damping is the sum; the motor has its share of it.
    viscous += drive.damping - kt**2 / resistance
    if viscous < 0:
        lost.append(
            f"{-viscous:.4g} of back-EMF: the motor's {kt**2 / resistance:.4g} N·m·s/rad is more than servo "
            "and joint damp in the calibrated model"
        )
    entry = {
        **_friction(values, float(model.dof_frictionloss[dof])),
        "friction_viscous": max(viscous, 0.0),
        "kt": kt,
        "R": resistance,
        "armature": float(model.dof_armature[dof] + gear * model.actuator_armature[actuator]),
        "command_delay": float(result.latency_s) + values.get("command_delay", 0.0),
        "actuator": "mx64",
        "kp": drive.stiffness * resistance / (kt * SERVO["vin"] * SERVO["error_gain"]),
        **SERVO,
    }
    if "servo_speed_limit" in values:
        entry["max_velocity"] = values["servo_speed_limit"]
        lost.append("max_velocity, the set-point's speed: only BAM's class sts3215 has it")
    blind = [p.name for p in own if p.name in result.without_value]
    return {**entry, "without_value": blind, "cannot_express": lost}


def _friction(values: Mapping[str, float], coulomb: float) -> dict[str, Any]:
    """Return the friction law's name and coefficients in BAM's words."""
    found = {
        coefficient: value for kind, value in values.items() for coefficient in FRICTION_KINDS.get(kind, ())
    }
    speed = found.pop("stribeck_speed", STRIBECK_SPEED)
    found = {name: value for name, value in found.items() if value != 0}
    of = found.get
    loads = ("motor", "external", "motor_stribeck", "external_stribeck")
    loaded = any(name in found for name in loads)
    directed = (of("motor"), of("motor_stribeck")) != (of("external"), of("external_stribeck"))
    resting = "stribeck" in found or "motor_stribeck" in found or "external_stribeck" in found
    law: dict[str, Any] = {"friction_base": coulomb}
    if directed:
        law |= {"model": "m5"} | {f"load_friction_{name}": of(name, 0.0) for name in loads}
    elif loaded:
        law |= {"model": "m4" if resting else "m3", "load_friction_base": of("motor", 0.0)}
        law |= {"load_friction_stribeck": of("motor_stribeck", 0.0)} if resting else {}
    else:
        law["model"] = "m2" if resting else "m1"
    if law["model"] in ("m2", "m4", "m5"):
        law |= {"friction_stribeck": of("stribeck", 0.0), "dtheta_stribeck": speed, "alpha": EXPONENT}
    return law


def parameter_texts(
    result: CalibrationResult, parameters: Iterable[Parameter] | None = None
) -> list[tuple[str, str]]:
    """Return kind and a line for each calibrated or known value, of all parameters or some."""
    values = dict(zip(result.space.names, result.estimate, strict=True)) | result.space.known
    return [
        (p.kind, f"{p.name} = {float(values[p.name]):.5g} {p.unit} ({p.kind})")
        for p in (result.space.parameters if parameters is None else parameters)
    ]


def drive_texts(result: CalibrationResult, drive: JointDrive, name: str) -> list[str]:
    """Return a line for each part of an actuator that is only in the MJCF."""
    found = []
    searched = any(p.kind == "command_lag" and name in p.elements for p in result.space.parameters)
    if drive.lag_s > 0 and not searched:
        found.append(f"{name}: lag of {drive.lag_s:.4g} s of its command, the filter of the MJCF")
    if drive.offset:
        found.append(f"{name}: constant effort of {drive.offset:.4g} N·m or N (biasprm)")
    return found
