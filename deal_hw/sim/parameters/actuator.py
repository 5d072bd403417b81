"""Parameter kinds of actuators.

Position servos: force = clip(kp (setpoint - q) - kd q', +-limit). Motors: force = gain * control, joint
torque = gear * force. The parameter ``motor_gain`` is their product, the joint torque at a control of 1: a
gain alone has the joint's unit only where the gear is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import Kind

_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
_SERVO_ADVICE = "for a motor use motor_gain or motor_gear"


def servo_stiffness(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kp [N/m or N·m/rad]."""
    gain, bias = fields.get("actuator_gainprm"), fields.get("actuator_biasprm")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        gain[:, actuator, 0] = values
        bias[:, actuator, 1] = -values


def servo_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set kd [N·s/m or N·m·s/rad]."""
    bias = fields.get("actuator_biasprm")
    for name in elements:
        bias[:, element_id(fields.model, "actuator", name), 2] = -values


def servo_effort_limit(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the effort limit [N or N·m], the same to both sides."""
    limit = fields.get("actuator_forcerange")
    for name in elements:
        actuator = element_id(fields.model, "actuator", name)
        limit[:, actuator, 0] = -values
        limit[:, actuator, 1] = values


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


def _servo(model: Any, actuator: int, name: str) -> None:
    fixed = int(model.actuator_gaintype[actuator]) == _FIXED
    affine = int(model.actuator_biastype[actuator]) == _AFFINE
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    if not (fixed and affine and np.isclose(gain[0], -bias[1])):
        raise ConfigurationError(
            f"actuator {name!r} is no position servo (gain {gain[0]:g}, bias {bias[:3].tolist()}); "
            f"{_SERVO_ADVICE}"
        )


def _limited(model: Any, actuator: int, name: str) -> None:
    low, high = model.actuator_forcerange[actuator]
    if not (model.actuator_forcelimited[actuator] and np.isclose(-low, high)):
        raise ConfigurationError(
            f"actuator {name!r} has no symmetric effort limit in the model (forcerange {low:g} {high:g}); "
            "write one into the MJCF"
        )


def _motor(model: Any, actuator: int, name: str) -> None:
    fixed = int(model.actuator_gaintype[actuator]) == _FIXED
    if not fixed or np.any(model.actuator_biasprm[actuator]):
        raise ConfigurationError(f"actuator {name!r} is no motor; for a position servo use servo_stiffness")
    if model.actuator_gear[actuator, 0] == 0:
        raise ConfigurationError(
            f"actuator {name!r} has gear 0, so it moves nothing; give it another gear in the MJCF"
        )


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
        baseline=lambda m, i: float(m.actuator_gainprm[i, 0]),
        usable=_servo,
    ),
    Kind(
        name="servo_damping",
        element="actuator",
        quantity="servo_damping",
        unit="N·m·s/rad",
        unit_slide="N·s/m",
        writes=("actuator_biasprm",),
        along="nothing; the joint's own dof_damping adds to it",
        apply=servo_damping,
        baseline=lambda m, i: float(-m.actuator_biasprm[i, 2]),
        usable=_servo,
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
        baseline=lambda m, i: float(m.actuator_forcerange[i, 1]),
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
        quantity="gain",
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
        name="servo_play",
        element="actuator",
        quantity="play",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="the joint's set-point follows where the play is used up",
        apply=None,
        baseline=None,
        usable=_servo,
        scale="linear",
        spread=0.1,
    ),
)
