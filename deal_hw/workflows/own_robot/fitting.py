"""Puts measured servos into a robot.yaml: zeros, ranges and limits, after comparing them with the MJCF."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import RAD, HardwareSection, ServoEntry
from deal_hw.sim.robots.robot_file import JointEntry, RobotFile
from deal_hw.sim.robots.travel import Travel

STS3215_RAD_S: Final = 5.2
"""Fastest an STS3215 turns [rad/s]: 3400 ticks/s, the goal speed that it has after a start, at 7.4 V."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredServo(Travel):
    """A servo, and how far its joint can be turned.

    Attributes:
        model: Its model, such as sts3215.
        zero: Position where the joint's is 0 [ticks]; None: the middles of travel and MJCF's range agree.
        velocity_limit: Largest speed of the joint [rad/s].
        p_gain: Register of the P gain.
        d_gain: Register of the D gain.
    """

    model: str
    zero: int | None
    velocity_limit: float
    p_gain: int
    d_gain: int


def with_servos(
    file: RobotFile,
    measured: Sequence[MeasuredServo],
    *,
    bus: Literal["feetech", "dynamixel"],
    baud_rate: int,
    again: str,
) -> RobotFile:
    """Return a robot with its servos: the section ``hardware``, narrowed ranges, velocity limits.

    Args:
        file: The robot as its MJCF describes it.
        measured: The servo of each of its joints.
        bus: Their bus.
        baud_rate: Its rate [bit/s].
        again: How to measure a joint again, for messages.

    Raises:
        ConfigurationError: A travel is not that of the MJCF's joint, or the robot cannot be driven by servos.
    """
    entries, servos, problems = list(file.joints), [], []
    for one in measured:
        at = next(j for j, joint in enumerate(file.joints) if joint.name == one.joint)
        try:
            entries[at], servo = _fitted(file.joints[at], one, again)
        except ConfigurationError as error:
            problems.append(str(error))
        else:
            servos.append(servo)
    if problems:
        raise ConfigurationError("; ".join(problems))
    section = HardwareSection(
        bus=bus,
        baud_rate=baud_rate,
        passive="damping" if bus == "feetech" else "off",
        servos=tuple(servos),
    )
    return dataclasses.replace(file, joints=tuple(entries), hardware=section)


def _fitted(joint: JointEntry, one: MeasuredServo, again: str) -> tuple[JointEntry, ServoEntry]:
    if joint.position_range is None:
        raise ConfigurationError(
            f"joint {joint.name} has no range in the MJCF; give it one, and its actuator a ctrlrange"
        )
    zero, (low, high) = one.fitted(joint.position_range, one.zero, again)
    entry = dataclasses.replace(
        joint,
        position_range=(low, high),
        default_position=min(max(joint.default_position, low), high),
        velocity_limit=one.velocity_limit,
        sensor_resolution=joint.sensor_resolution or RAD,
    )
    return entry, ServoEntry(
        joint=joint.name,
        id=one.id,
        model=one.model,
        zero=zero,
        direction=one.direction,
        p_gain=one.p_gain,
        d_gain=one.d_gain,
    )
