"""Parameter kinds of actuators, in units of the joint behind the gear.

Position servos: effort = clip(kp (setpoint - q) - kd q', +-limit). Velocity servos: effort = kd (speed - q').
Motors: effort = gain * control - kd q'. :mod:`deal_hw.sim.parameters.drive` says how an MJCF writes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.drive import drive_of, filtered, setpoint_ratio, speed_servo
from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import DAMPING_RATIO, Kind

_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
_SERVO_ADVICE = "for a motor use motor_gain or motor_gear"


def servo_stiffness(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kp [N/m or N·m/rad]; a scaled set-point stays scaled."""
    gain, bias = fields.get("actuator_gainprm"), fields.get("actuator_biasprm")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        before = values / _gear(fields.model, actuator) ** 2
        bias[:, actuator, 1] = -before
        gain[:, actuator, 0] = before * setpoint_ratio(fields.model, actuator)


def servo_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kd [N·s/m or N·m·s/rad]; a velocity servo's gain stays equal to it."""
    gain, bias = fields.get("actuator_gainprm"), fields.get("actuator_biasprm")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        before = values / _gear(fields.model, actuator) ** 2
        bias[:, actuator, 2] = -before
        if speed_servo(fields.model, actuator):
            gain[:, actuator, 0] = before


def servo_effort_limit(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the effort limit [N or N·m], the same to both sides."""
    limit = fields.get("actuator_forcerange")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        force = values / abs(_gear(fields.model, actuator))
        limit[:, actuator, 0] = -force
        limit[:, actuator, 1] = force


def motor_gain(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set a motor's effort at the joint for a control of 1, behind the gear [N or N·m]; its sign stays."""
    gain = fields.get("actuator_gainprm")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        own = fields.model.actuator_gainprm[actuator, 0]
        gain[:, actuator, 0] = np.copysign(values / abs(fields.model.actuator_gear[actuator, 0]), own)


def motor_gear(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the ratio of joint torque to actuator force; the sign of the model's gear stays."""
    gear = fields.get("actuator_gear")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        gear[:, actuator, 0] = np.copysign(values, fields.model.actuator_gear[actuator, 0])


def _gear(model: Any, actuator: int) -> float:
    return float(model.actuator_gear[actuator, 0])


def _servo(model: Any, actuator: int, name: str) -> None:
    if drive_of(model, actuator, name).takes != "position":
        gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
        raise ConfigurationError(
            f"actuator {name!r} is no position servo (gain {gain[0]:g}, bias {bias[:3].tolist()}); "
            f"{_SERVO_ADVICE}"
        )


def _damped(model: Any, actuator: int, name: str) -> None:
    drive_of(model, actuator, name)
    if int(model.actuator_biastype[actuator]) != _AFFINE:
        raise ConfigurationError(
            f"actuator {name!r} has no damping of its own (no biastype affine); search its joint's "
            f"dof_damping; {_SERVO_ADVICE}"
        )


def _limited(model: Any, actuator: int, name: str) -> None:
    low, high = model.actuator_forcerange[actuator]
    if not (model.actuator_forcelimited[actuator] and np.isclose(-low, high)):
        raise ConfigurationError(
            f"actuator {name!r} has no symmetric effort limit in the model (forcerange {low:g} {high:g}); "
            "write one into the MJCF"
        )


def _motor(model: Any, actuator: int, name: str) -> None:
    takes = drive_of(model, actuator, name).takes
    if takes == "position":
        raise ConfigurationError(f"actuator {name!r} is no motor; for a position servo use servo_stiffness")
    if takes == "velocity":
        raise ConfigurationError(
            f"actuator {name!r} is a velocity servo; its only gain is servo_damping, effort an error of the "
            "speed"
        )


def _commanded(model: Any, actuator: int, name: str) -> None:
    if drive_of(model, actuator, name).takes == "position":
        raise ConfigurationError(f"actuator {name!r} is no motor; for a position servo use servo_stiffness")


ACTUATOR_KINDS = (
    Kind(
        name="servo_stiffness",
        element="actuator",
        quantity="servo_stiffness",
        unit="N·m/rad",
        unit_slide="N/m",
        writes=("actuator_gainprm", "actuator_biasprm"),
        along="gain and bias stay opposite",
        apply=servo_stiffness,
        baseline=lambda m, i: drive_of(m, i, m.actuator(i).name).stiffness,
        usable=_servo,
    ),
    Kind(
        name="servo_damping",
        element="actuator",
        quantity="servo_damping",
        unit="N·m·s/rad",
        unit_slide="N·s/m",
        writes=("actuator_biasprm", "actuator_gainprm"),
        along="a velocity servo's gain; the joint's own dof_damping adds to it",
        apply=servo_damping,
        baseline=lambda m, i: drive_of(m, i, m.actuator(i).name).damping,
        usable=_damped,
        ratio=DAMPING_RATIO,
    ),
    Kind(
        name="servo_effort_limit",
        element="actuator",
        quantity="servo_effort_limit",
        unit="N·m",
        unit_slide="N",
        writes=("actuator_forcerange",),
        along="both sides alike",
        apply=servo_effort_limit,
        baseline=lambda m, i: float(m.actuator_forcerange[i, 1] * abs(m.actuator_gear[i, 0])),
        usable=_limited,
    ),
    Kind(
        name="servo_speed_limit",
        element="actuator",
        quantity="servo_speed_limit",
        unit="rad/s",
        unit_slide="m/s",
        writes=(),
        along="the set-point generator in front of the actuator applies it",
        apply=None,
        baseline=None,
    ),
    Kind(
        name="motor_gain",
        element="actuator",
        quantity="motor_gain",
        unit="N·m",
        unit_slide="N",
        writes=("actuator_gainprm",),
        along="nothing; gear and signs stay",
        apply=motor_gain,
        baseline=lambda m, i: float(abs(m.actuator_gainprm[i, 0] * m.actuator_gear[i, 0])),
        usable=_motor,
    ),
    Kind(
        name="motor_gear",
        element="actuator",
        quantity="gear",
        unit="-",
        writes=("actuator_gear",),
        along="nothing; the sign stays",
        apply=motor_gear,
        baseline=lambda m, i: float(abs(m.actuator_gear[i, 0])),
        usable=_motor,
    ),
    Kind(
        name="command_delay",
        element="actuator",
        quantity="command_delay",
        unit="s",
        writes=(),
        along="set-points act later by it, on top of the latency that is scanned",
        apply=None,
        baseline=None,
        scale="linear",
        spread=0.02,
    ),
    Kind(
        name="command_lag",
        element="actuator",
        quantity="lag",
        unit="s",
        writes=(),
        along="set-points or efforts follow commands as a first-order lag of this time constant",
        apply=None,
        baseline=lambda m, i: float(m.actuator_dynprm[i, 0]) if filtered(m, i) else 0.0,
    ),
    Kind(
        name="command_dead_zone",
        element="actuator",
        quantity="dead_zone",
        unit="of the command",
        writes=(),
        along="commands of a motor up to this size have no effect, larger ones lose it",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_commanded,
        scale="linear",
        spread=0.2,
    ),
    Kind(
        name="command_asymmetry",
        element="actuator",
        quantity="asymmetry",
        unit="-",
        writes=(),
        along="positive commands of a motor do more by this share, negative ones less",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_commanded,
        scale="linear",
        spread=0.3,
        least=-1.0,
        most=1.0,
    ),
    Kind(
        name="command_saturation",
        element="actuator",
        quantity="saturation",
        unit="of the command",
        writes=(),
        along="larger commands of a motor act as this one",
        apply=None,
        baseline=None,
        usable=_commanded,
    ),
    Kind(
        name="servo_play",
        element="actuator",
        quantity="play",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="a dead zone of the command: the set-point of the joint follows where the play is used up",
        apply=None,
        baseline=None,
        usable=_servo,
        scale="linear",
        spread=0.1,
    ),
)
