"""The description of a robot from its robot.yaml alone, for drivers: without MuJoCo."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription, SafetyLimits, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.robot_file import ActuatorEntry, JointEntry, RobotFile

OVERSHOOT: Final = 0.25
"""Share of the range by which a measured position may exceed it before a run trips."""
LEAST_AGE_S: Final = 0.1
AGE_PERIODS: Final = 5
"""Age of states and actions that trips: this many control periods, at least LEAST_AGE_S."""
TARGET_SHARE: Final = 0.7
"""Targets of a driven arm move at most at this share of its velocity limit, at which a run trips: a joint
with little damping overshoots the speed of its target by a third."""
EASE_IN_S: Final = 1.0
"""A driven arm gets to a policy's first targets in this time [s]; SO-101 and cart-pole have the same."""


def sensor_of(file: RobotFile) -> SensorModel:
    """Return the sensor model of a robot.yaml."""
    return SensorModel(
        noise=tuple(joint.sensor_noise for joint in file.joints),
        resolution=tuple(joint.sensor_resolution for joint in file.joints),
        velocity_window_s=0.0,
    )


def limits_of(file: RobotFile, control_rate_hz: float) -> SafetyLimits:
    """Return the limits of the safety filter that a robot.yaml states.

    Args:
        file: The robot.
        control_rate_hz: Commands per second, which may be those of recordings.
    """
    joints = file.joints
    driven = [(joint, joint.actuator) for joint in joints if joint.actuator is not None]
    free = (math.inf,) * len(driven)
    hardware = file.hardware is not None
    share = TARGET_SHARE if hardware else 1.0
    age_s = max(LEAST_AGE_S, AGE_PERIODS / control_rate_hz)
    return SafetyLimits(
        target=tuple(
            (-1.0, 1.0) if takes_effort(file, actuator) else _range(joint) for joint, actuator in driven
        ),
        target_step=tuple(
            math.inf
            if takes_effort(file, actuator)
            else share * free_of(joint.velocity_limit) / control_rate_hz
            for joint, actuator in driven
        ),
        target_distance=free,
        trip_position=tuple(_trip_range(joint) for joint in joints),
        trip_velocity=tuple(free_of(joint.velocity_limit) for joint in joints),
        stiffness=tuple(actuator.stiffness for _, actuator in driven) if hardware else free,
        damping=tuple(actuator.damping for _, actuator in driven) if hardware else free,
        effort=tuple(free_of(actuator.effort_limit) for _, actuator in driven),
        speed=free,
        state_age_s=age_s,
        action_age_s=age_s,
        ease_in_s=EASE_IN_S if hardware else 0.0,
        may_be_blocked=tuple(joint.name for joint, _ in driven if joint.may_be_blocked),
    )


def takes_effort(file: RobotFile, actuator: ActuatorEntry) -> bool:
    """Return whether a drive of a robot.yaml takes efforts: beside servos, one without stiffness does.

    On a bus all drives take positions, also where their stiffness is not known.
    """
    return file.actuation == "motor" or (file.hardware is None and actuator.stiffness == 0.0)


def file_description(file: RobotFile, mjcf: Path) -> RobotDescription:
    """Return the description of a robot that hardware drives.

    Args:
        file: The robot.
        mjcf: Its model, which is not compiled.

    Raises:
        ConfigurationError: The file does not note the MJCF's timestep.
    """
    if file.physics_step is None:
        raise ConfigurationError(
            f"robot {file.name!r}: write the timestep of its MJCF at `physics_step` (robot check prints it)"
        )
    joints = file.joints
    driven = [(joint, joint.actuator) for joint in joints if joint.actuator is not None]
    substeps = max(round(1.0 / file.state_rate_hz / file.physics_step), 1)
    return RobotDescription(
        name=file.name,
        joint_names=tuple(joint.name for joint in joints),
        actuated=tuple(joint.name for joint, _ in driven),
        position_units=tuple(joint.unit for joint in joints),
        default_position=tuple(joint.default_position for joint in joints),
        stiffness=tuple(actuator.stiffness for _, actuator in driven),
        damping=tuple(actuator.damping for _, actuator in driven),
        effort_limit=tuple(free_of(actuator.effort_limit) for _, actuator in driven),
        speed_limit=(math.inf,) * len(driven),
        control_rate_hz=file.control_rate_hz,
        device_rate_hz=file.state_rate_hz * substeps,
        state_rate_hz=file.state_rate_hz,
        limits=limits_of(file, file.control_rate_hz),
        sensor=sensor_of(file),
        mjcf=mjcf,
        actuation=file.actuation,
        floating_base=file.floating_base,
        feet=file.feet,
        sources=dict.fromkeys(
            (
                "joint_names",
                "stiffness",
                "damping",
                "limits",
                "sensor",
                "default_position",
                "effort_limit",
            ),
            "robot.yaml",
        ),
    )


def free_of(limit: float | None) -> float:
    """Return a limit; infinite for none."""
    return math.inf if limit is None else limit


def _range(joint: JointEntry) -> tuple[float, float]:
    return joint.position_range or (-math.inf, math.inf)


def _trip_range(joint: JointEntry) -> tuple[float, float]:
    if joint.position_range is None:
        return -math.inf, math.inf
    low, high = joint.position_range
    slack = OVERSHOOT * (high - low)
    return low - slack, high + slack
