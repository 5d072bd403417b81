"""A robot description from any MJCF: the facts that calibration needs of a robot without a driver."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import actuator_of
from deal_hw.sim.mjcf.notes import BODY, passive_balls
from deal_hw.sim.mjcf.urdf import require_drives
from deal_hw.sim.parameters.drive import JointDrive, drive_of
from deal_hw.sim.parameters.fields import element_id, element_names
from deal_hw.sim.parameters.followers import followers_of
from deal_hw.sim.parameters.kind import HINGE, SLIDE, joint_of
from deal_hw.sim.parameters.one_drive import brakes

WINDOW_TICKS = 20
"""Control periods in a search's longest window, whose length is ``--window``."""

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
        ConfigurationError: A joint or actuator of the model was not recorded, or an actuator is of an unknown
            kind.
        UnknownNameError: The model lacks a joint.
    """
    index = [element_id(model, "joint", name) for name in joints]
    require_drives(mjcf, model, actuated)
    free = _check_joints(model, index)
    actuators = [actuator_of(model, name) for name in actuated]
    _check_actuators(model, actuators, actuated)
    # Without actuators there is nothing to command, as with motors that are off.
    drives = [_drive(model, i, name) for i, name in zip(actuators, actuated, strict=True)]
    servos = [drive.takes == "position" for drive in drives]
    return RobotDescription(
        name=mjcf.stem,
        joint_names=tuple(joints),
        actuated=tuple(actuated),
        position_units=tuple("m" if model.jnt_type[j] == SLIDE else "rad" for j in index),
        default_position=tuple(float(model.qpos0[model.jnt_qposadr[j]]) for j in index),
        stiffness=tuple(drive.stiffness for drive in drives),
        damping=tuple(d.damping if servo else 0.0 for d, servo in zip(drives, servos, strict=True)),
        # A motor has its effort at a control of 1.
        effort_limit=tuple(
            d.effort_limit if servo else abs(d.gain) for d, servo in zip(drives, servos, strict=True)
        ),
        speed_limit=(math.inf,) * len(actuated),
        control_rate_hz=1.0 / (rates.period_s * rates.samples_per_tick),
        device_rate_hz=1.0 / rates.step_s,
        state_rate_hz=1.0 / rates.period_s,
        limits=_no_limits(len(joints), len(actuated)),
        sensor=SensorModel(
            noise=(0.0,) * len(joints), resolution=(0.0,) * len(joints), velocity_window_s=0.0
        ),
        mjcf=mjcf,
        actuation="position" if any(servos) else "motor",
        motors=tuple(name for name, servo in zip(actuated, servos, strict=True) if any(servos) and not servo),
        floating_base=free,
        sources={
            "joint_names": "the recording's column map",
            "stiffness": "gain of the MJCF's position actuators, at the joint",
            "damping": "velocity term of the same actuators, at the joint",
            "effort_limit": "the same actuators' forcerange at the joint, or the joint's actuatorfrcrange; "
            "infinite where there is none",
            "state_rate_hz": "the recording's own stamps",
            "device_rate_hz": "the physics step: the MJCF's timestep fitted into the sampling period",
            "control_rate_hz": "unit of window lengths: the sampling rate over a whole number",
        },
    )


def at_rates(description: RobotDescription, rates: Sampling) -> RobotDescription:
    """Return the description with the rates of recordings."""
    return dataclasses.replace(
        description,
        control_rate_hz=1.0 / (rates.period_s * rates.samples_per_tick),
        device_rate_hz=1.0 / rates.step_s,
        state_rate_hz=1.0 / rates.period_s,
    )


def slowest(rates: Sequence[Sampling]) -> Sampling:
    """Return the sampling that describes a robot with recordings of several rates: the slowest."""
    return max(rates, key=lambda each: each.period_s)


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
    """Check that every joint was recorded or follows such; return the base's free joint, if any."""
    free: str | None = None
    missing, several = list[str](), list[str]()
    led = {follower.joint for follower in followers_of(model, recorded)} | set(passive_balls(model))
    for index in range(model.njnt):
        name = model.joint(index).name
        if model.jnt_type[index] == _FREE and free is None and name:
            free = name
        elif index not in recorded and index not in led:
            single = model.jnt_type[index] in (HINGE, SLIDE)
            (missing if single else several).append(name or f"joint {index}")
    if several:
        raise ConfigurationError(
            f"joints of the model with several coordinates, which no recording has: {', '.join(several)} (a "
            "driven ball joint, or a second or unnamed free joint); remove <joint> or <freejoint> there in a "
            "copy of the MJCF, or write three hinges"
        )
    if missing:
        raise ConfigurationError(
            f"joints of the model without a recorded position: {', '.join(missing)}; add them to the column "
            "map, or fix them in a copy of the MJCF: deal-hw robot lock MODEL --joints NAME=VALUE ..."
        )
    return free


def _check_actuators(model: Any, actuators: Sequence[int], actuated: Sequence[str]) -> None:
    held = {i for i in range(model.nu) if model.actuator_trntype[i] == BODY}
    used = {*actuators, *brakes(model), *held}
    idle = [model.actuator(i).name or f"number {i}" for i in range(model.nu) if i not in used]
    apart = [
        f"{model.actuator(i).name or f'number {i}'} (a {DRIVEN.get(int(model.actuator_trntype[i]), 'body')})"
        for i in range(model.nu)
        if i not in used and joint_of(model, i) < 0
    ]
    if apart:
        raise ConfigurationError(
            f"actuators of the model that drive no joint: {', '.join(apart)}; calibration takes commands of "
            "joints: let them drive a joint, or fix the joints that they move in a copy of the MJCF, which "
            "removes them: deal-hw robot lock MODEL --joints NAME=VALUE ..."
        )
    if idle:
        raise ConfigurationError(
            f"actuators of the model without recorded commands: {', '.join(idle)}; name their `target` in "
            "the column map, or remove them from a copy of the MJCF"
        )


def _drive(model: Any, actuator: int, joint: str) -> JointDrive:
    return drive_of(model, actuator, model.actuator(actuator).name or f"of joint {joint}")


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
