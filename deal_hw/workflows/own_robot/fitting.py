"""Puts measured servos into a robot.yaml: zeros, ranges and limits, after comparing them with the MJCF."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import RAD, TICKS, HardwareSection, ServoEntry
from deal_hw.sim.robots.robot_file import JointEntry, RobotFile

STS3215_RAD_S: Final = 5.2
"""Fastest an STS3215 turns [rad/s]: 3400 ticks/s, the goal speed that it has after a start, at 7.4 V."""
MOST_DIFFERENCE: Final = 0.3
"""Largest share of the wider one of travel and MJCF's range that the two do not have in common.

Arms of one kind differ: recorded jaws of SO-101 travel 2.34 rad, its published MJCF allows 1.92 rad. Another
joint's travel, and a wrong zero, differ by more.
"""
_DECIMALS: Final = 1e4
"""Ends of ranges are written with 4 decimals, a 15th of a tick, rounded inwards [1/rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredServo:
    """A servo, and how far its joint can be turned.

    Attributes:
        joint: The joint.
        id: The servo's id.
        model: Its model, such as sts3215.
        direction: 1 if the joint's position grows with the servo's, else -1.
        low: Lowest position of the joint's travel [ticks].
        high: Highest one [ticks].
        zero: Position where the joint's is 0 [ticks]; None: the middles of travel and MJCF's range agree.
        velocity_limit: Largest speed of the joint [rad/s].
        p_gain: Register of the P gain.
        d_gain: Register of the D gain.
        travels: Whether ``low`` and ``high`` are ends of a travel; False if they are just those of a turn.
    """

    joint: str
    id: int
    model: str
    direction: Literal[1, -1]
    low: int
    high: int
    zero: int | None
    velocity_limit: float
    p_gain: int
    d_gain: int
    travels: bool = True


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


def angles(low: int, high: int, zero: int, direction: int) -> tuple[float, float]:
    """Return the lower and the higher position of a joint at the ends of a range of ticks [rad]."""
    ends = sorted(direction * (ticks - zero) * RAD for ticks in (low, high))
    return ends[0], ends[1]


def middle_zero(low: int, high: int, direction: int, joint_range: tuple[float, float]) -> int:
    """Return the zero with which the middles of a travel [ticks] and of a joint's range [rad] agree."""
    return round((low + high) / 2 - direction * sum(joint_range) / 2 / RAD)


def _fitted(joint: JointEntry, one: MeasuredServo, again: str) -> tuple[JointEntry, ServoEntry]:
    if joint.position_range is None:
        raise ConfigurationError(
            f"joint {joint.name} has no range in the MJCF; give it one, and its actuator a ctrlrange"
        )
    low, high = joint.position_range
    zero = one.zero
    if zero is None:
        zero = middle_zero(one.low, one.high, one.direction, joint.position_range)
    if not 0 <= zero < TICKS:
        raise ConfigurationError(
            f"joint {joint.name}: its MJCF's 0 would be at {zero} ticks of servo {one.id}, which counts 0 to "
            f"{TICKS - 1}. Turn the horn, or set the servo's homing offset, and {again}"
        )
    if one.travels:
        ends = angles(one.low, one.high, zero, one.direction)
        common = min(high, ends[1]) - max(low, ends[0])
        share = max(common, 0.0) / max(high - low, ends[1] - ends[0])
        if share < 1 - MOST_DIFFERENCE:
            raise ConfigurationError(
                f"joint {joint.name}: servo {one.id} travels from {ends[0]:.2f} to {ends[1]:.2f} rad, the "
                f"MJCF's range is {low:.2f} to {high:.2f} rad: they have {100 * share:.0f} % in common, and "
                f"{100 * (1 - MOST_DIFFERENCE):.0f} % are needed. It is another arm, its zero "
                f"is wrong, or not its whole travel was measured: {again}, or correct the MJCF's range"
            )
        low = max(low, math.ceil(ends[0] * _DECIMALS) / _DECIMALS)
        high = min(high, math.floor(ends[1] * _DECIMALS) / _DECIMALS)
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
