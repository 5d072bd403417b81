"""A robot description from any MJCF: the facts that calibration needs of a robot without a driver."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import actuator_of
from deal_hw.sim.parameters.fields import element_id, element_names
from deal_hw.sim.parameters.kind import HINGE, SLIDE, joint_of

WINDOW_TICKS = 20
"""Control periods in a search's longest window, whose length is ``--window``."""

_JOINT = int(mujoco.mjtTrn.mjTRN_JOINT)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
DRIVEN = {
    int(mujoco.mjtTrn.mjTRN_TENDON): "tendon",
    int(mujoco.mjtTrn.mjTRN_SITE): "site",
    int(mujoco.mjtTrn.mjTRN_SLIDERCRANK): "slider-crank",
}
"""What an actuator drives that has no joint."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Position of a recording's samples on the physics grid.

    Attributes:
        period_s: Sampling period [s].
        substeps: Physics steps in it.
        samples_per_tick: Samples in one control period, the unit of window lengths.
    """

    period_s: float
    substeps: int
    samples_per_tick: int

    @property
    def step_s(self) -> float:
        """Physics step [s]."""
        return self.period_s / self.substeps


def sampling(period_s: float, timestep_s: float, window_s: float) -> Sampling:
    """Fit the physics grid to a sampling period: a whole number of steps near the wanted one.

    Args:
        period_s: Sampling period of the recordings [s].
        timestep_s: Wanted physics step, such as the MJCF's [s].
        window_s: Wanted length of a search's longest windows [s].

    Raises:
        ConfigurationError: The step or the window is not positive.
    """
    if not window_s > 0:
        raise ConfigurationError(f"the window must be above 0, got {window_s:g} s")
    if not timestep_s > 0:
        raise ConfigurationError(f"the physics step must be above 0, got {timestep_s:g} s")
    return Sampling(
        period_s=period_s,
        substeps=max(round(period_s / timestep_s), 1),
        samples_per_tick=max(round(window_s / WINDOW_TICKS / period_s), 1),
    )


def describe(
    mjcf: Path, model: Any, joints: Sequence[str], actuated: Sequence[str], rates: Sampling
) -> RobotDescription:
    """Describe the robot of a model by its recordings.

    Args:
        mjcf: The model's file.
        model: The compiled model.
        joints: The recorded joints, in the recording's order.
        actuated: Those with commands, in command order.
        rates: Sampling of the recordings.

    Raises:
        ConfigurationError: A joint or actuator of the model was not recorded, an actuator is of an unknown
            kind, or servos and motors are mixed.
        UnknownNameError: The model lacks a joint.
    """
    index = [element_id(model, "joint", name) for name in joints]
    free = _check_joints(model, index)
    actuators = [actuator_of(model, name) for name in actuated]
    _check_actuators(model, actuators, actuated)
    # Without actuators there is nothing to command, as with motors that are off.
    kinds = {_actuation(model, i, name) for i, name in zip(actuators, actuated, strict=True)} or {"motor"}
    if len(kinds) > 1:
        raise ConfigurationError(
            "some actuators of the model are position servos, some are motors; calibration takes one kind"
        )
    actuation = kinds.pop()
    servo = actuation == "position"
    limits = [_effort_limit(model, i, servo) for i in actuators]
    return RobotDescription(
        name=mjcf.stem,
        joint_names=tuple(joints),
        actuated=tuple(actuated),
        position_units=tuple("m" if model.jnt_type[j] == SLIDE else "rad" for j in index),
        default_position=tuple(float(model.qpos0[model.jnt_qposadr[j]]) for j in index),
        stiffness=tuple(float(model.actuator_gainprm[i, 0]) if servo else 0.0 for i in actuators),
        damping=tuple(float(-model.actuator_biasprm[i, 2]) if servo else 0.0 for i in actuators),
        effort_limit=tuple(limits),
        speed_limit=(math.inf,) * len(actuated),
        control_rate_hz=1.0 / (rates.period_s * rates.samples_per_tick),
        device_rate_hz=1.0 / rates.step_s,
        state_rate_hz=1.0 / rates.period_s,
        limits=_no_limits(len(joints), len(actuated)),
        sensor=SensorModel(
            noise=(0.0,) * len(joints), resolution=(0.0,) * len(joints), velocity_window_s=0.0
        ),
        mjcf=mjcf,
        actuation=actuation,
        floating_base=free,
        sources={
            "joint_names": "the recording's column map",
            "stiffness": "gain of the MJCF's position actuators",
            "damping": "velocity term of the same actuators",
            "effort_limit": "forcerange of the same actuators; infinite where there is none",
            "state_rate_hz": "the recording's own stamps",
            "device_rate_hz": "the physics step: the MJCF's timestep fitted into the sampling period",
            "control_rate_hz": "unit of window lengths: the sampling rate over a whole number",
        },
    )


def with_speed_limits(description: RobotDescription, model: Any, space: ParameterSpace) -> RobotDescription:
    """Return the description with set-point speed limits from the parameters' nominal values.

    An MJCF has no such limits; members scale these.
    """
    limits = list(description.speed_limit)
    for p in space.parameters:
        for name in p.elements if p.kind == "servo_speed_limit" else ():
            joint = joint_of(model, element_id(model, "actuator", name))
            limits[description.actuated.index(element_names(model, "joint")[joint])] = p.nominal
    return dataclasses.replace(description, speed_limit=tuple(limits))


def _check_joints(model: Any, recorded: Sequence[int]) -> str | None:
    """Check that every joint was recorded; return the name of the base's free joint, if any."""
    free: str | None = None
    missing = []
    for index in range(model.njnt):
        name = model.joint(index).name
        if model.jnt_type[index] == _FREE and free is None and name:
            free = name
        elif index not in recorded:
            word = (
                ""
                if model.jnt_type[index] in (HINGE, SLIDE)
                else " (ball, or a second or unnamed free joint)"
            )
            missing.append((name or f"joint {index}") + word)
    if missing:
        raise ConfigurationError(
            f"joints of the model without a recorded position: {', '.join(missing)}; add them to the column "
            "map, or remove the <joint> from a copy of the MJCF, which fixes the body where it is"
        )
    return free


def _check_actuators(model: Any, actuators: Sequence[int], actuated: Sequence[str]) -> None:
    idle = [model.actuator(i).name or f"number {i}" for i in range(model.nu) if i not in actuators]
    apart = [
        f"{model.actuator(i).name or f'number {i}'} (a {DRIVEN.get(int(model.actuator_trntype[i]), 'body')})"
        for i in range(model.nu)
        if i not in actuators and joint_of(model, i) < 0
    ]
    if apart:
        raise ConfigurationError(
            f"actuators of the model that drive no joint: {', '.join(apart)}; calibration takes commands of "
            "joints: remove these actuators from a copy of the MJCF, or let them drive a joint"
        )
    if idle:
        raise ConfigurationError(
            f"actuators of the model without recorded commands: {', '.join(idle)}; name their `target` in "
            "the column map, or remove them from a copy of the MJCF"
        )


def _actuation(model: Any, actuator: int, joint: str) -> str:
    """Return an actuator's kind of command, as in :class:`RobotDescription`."""
    name = model.actuator(actuator).name or f"of joint {joint}"
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    plain = (
        int(model.actuator_trntype[actuator]) == _JOINT
        and int(model.actuator_dyntype[actuator]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    )
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    if plain and affine and gain[0] > 0 and bias[0] == 0 and np.isclose(gain[0], -bias[1]):
        if not np.isclose(model.actuator_gear[actuator, 0], 1.0):
            raise ConfigurationError(
                f"position actuator {name!r} has gear {model.actuator_gear[actuator, 0]:g}, recordings hold "
                "joint positions; write gear 1, kp and kv times the gear squared, forcerange times the gear, "
                "ctrlrange divided by it"
            )
        return "position"
    if plain and not affine and not np.any(bias):
        return "motor"
    raise ConfigurationError(
        f"actuator {name!r} is neither a position servo (<position kp kv>) nor a motor (<motor>); "
        "calibration knows these two: replace it in a copy of the MJCF"
    )


def _effort_limit(model: Any, actuator: int, servo: bool) -> float:
    """Return a servo's symmetric force limit, infinite for none; a motor's torque at control 1."""
    if not servo:
        return float(abs(model.actuator_gear[actuator, 0] * model.actuator_gainprm[actuator, 0]))
    low, high = model.actuator_forcerange[actuator]
    if not model.actuator_forcelimited[actuator] or not np.isclose(-low, high):
        return math.inf
    return float(high)


def _no_limits(joints: int, actuated: int) -> SafetyLimits:
    free = (math.inf,) * actuated
    return SafetyLimits(
        target=((-math.inf, math.inf),) * actuated,
        target_step=free,
        target_distance=free,
        trip_position=((-math.inf, math.inf),) * joints,
        trip_velocity=(math.inf,) * joints,
        stiffness=free,
        damping=free,
        effort=free,
        speed=free,
        state_age_s=math.inf,
        action_age_s=math.inf,
        ease_in_s=0.0,
    )
