"""The section ``hardware`` of a robot.yaml: the bus of its servos, and the servo of each joint.

Positions of servos are in ticks, as their registers count them: :data:`TICKS` a turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

from deal_hw.schema import FINITE, refusal

TICKS: Final = 4096
"""Ticks a turn, of Feetech STS and of Dynamixel X servos (12 bits)."""
RAD: Final = 2 * math.pi / TICKS
"""One tick [rad]."""
MOST_SERVOS: Final = 32
_BAUD_RATES: Final = {
    "feetech": (128_000, 250_000, 500_000, 1_000_000),
    "dynamixel": (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000),
}
"""Rates that both ends name alike; at the slower ones of a servo a cycle of an arm takes too long."""
MOST_GAIN: Final = {"feetech": 254, "dynamixel": 16383}


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoEntry:
    """The servo of one joint.

    Attributes:
        joint: The joint.
        id: The servo's id on the bus.
        zero: Position of the servo where the joint's position is 0 [ticks].
        direction: 1 if the joint's position grows with the servo's, else -1.
        model: The servo's model, such as sts3215; "": any.
        rest: Where the joint may go limp [rad]: a planned end moves the arm there first. None for all: none.
        p_gain: Register of the position loop's P gain at the joint's stiffness.
        d_gain: Register of its D gain at the joint's damping.
        i_gain: Register of its I gain. An integral hides friction and load from the recordings.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    joint: str
    id: int
    zero: int
    p_gain: int
    d_gain: int = 0
    i_gain: int = 0
    direction: Literal[1, -1] = 1
    model: str = ""
    rest: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.id <= 252:
            raise refusal("id", self.id, "0 to 252")
        if not 0 <= self.zero < TICKS:
            raise refusal("zero", self.zero, f"0 to {TICKS - 1} ticks")

    def ticks(self, position: float) -> int:
        """Return the servo's position [ticks] at a position of the joint [rad]."""
        return self.zero + self.direction * round(position * TICKS / (2 * math.pi))

    def position(self, ticks: int) -> float:
        """Return the joint's position [rad] at a position of the servo [ticks]."""
        return self.direction * (ticks - self.zero) * RAD


@dataclass(frozen=True, slots=True, kw_only=True)
class HardwareSection:
    """The section ``hardware``.

    Attributes:
        bus: "feetech" (STS and SMS series) or "dynamixel" (X series).
        servos: The servo of each joint.
        baud_rate: Rate of the bus [bit/s].
        passive: What a run does at its end and on a fault: "off" (no torque: the arm falls) or "damping" (the
            motors brake; Feetech only).
        answer_ms: Time that an answer may take beyond its bytes' [ms]: the servos' return delay and the
            adapter's.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = FINITE

    bus: Literal["feetech", "dynamixel"]
    servos: tuple[ServoEntry, ...]
    baud_rate: int = 1_000_000
    passive: Literal["off", "damping"] = "off"
    answer_ms: float = 8.0

    def __post_init__(self) -> None:
        if self.baud_rate not in (rates := _BAUD_RATES[self.bus]):
            raise refusal("baud_rate", self.baud_rate, ", ".join(map(str, rates)))
        if self.passive == "damping" and self.bus != "feetech":
            raise refusal("passive", self.passive, "off; only Feetech servos can brake without a target")
        if not 0 <= self.answer_ms <= 100:
            raise refusal("answer_ms", self.answer_ms, "0 to 100 ms")
        for name in ("id", "joint"):
            given = [getattr(servo, name) for servo in self.servos]
            if not 0 < len(given) <= MOST_SERVOS or len(set(given)) != len(given):
                raise refusal(f"servos: {name}", given, f"1 to {MOST_SERVOS} servos, each {name} once")
        most = MOST_GAIN[self.bus]
        without = [servo.joint for servo in self.servos if servo.rest is None]
        if without and len(without) < len(self.servos):
            raise refusal(
                "rest", f"missing for {', '.join(without)}", "one for each servo, or none", quote=False
            )
        for servo in self.servos:
            for name in ("p_gain", "i_gain", "d_gain"):
                gain, least = getattr(servo, name), int(name == "p_gain")
                if not least <= gain <= most:
                    raise refusal(f"{name} of {servo.joint}", gain, f"{least} to {most}")


@dataclass(frozen=True, slots=True)
class HardwareJoint:
    """What the section's checks need of a joint.

    Attributes:
        name: The joint.
        driven: Whether it has an actuator.
        unit: "rad" or "m".
        position_range: Range of its targets [rad]; None for none.
        velocity_limit: Its largest speed [rad/s]; None for none.
    """

    name: str
    driven: bool
    unit: str
    position_range: tuple[float, float] | None
    velocity_limit: float | None


def hardware_problems(
    section: HardwareSection, joints: Sequence[HardwareJoint], *, actuation: str, floating: bool
) -> Iterator[str]:
    """Yield what keeps a robot from being driven by a section, each with what to write instead."""
    if actuation != "position":
        yield "actuation is motor; servos on a bus take positions: use position actuators in the MJCF"
    if floating:
        yield "the base floats; a robot on a servo bus has a fixed base: remove the free joint"
    servos = {servo.joint: servo for servo in section.servos}
    names = [joint.name for joint in joints]
    if unknown := [name for name in servos if name not in names]:
        yield f"servos of {', '.join(unknown)}: no such joint; joints are {', '.join(names)}"
    for joint in joints:
        servo = servos.get(joint.name)
        if servo is None:
            yield f"joint {joint.name} has no servo, so nothing measures it; add it to servos"
            continue
        if not joint.driven:
            yield f"joint {joint.name} has a servo but no actuator; give it a position actuator in the MJCF"
        if joint.unit != "rad":
            yield f"joint {joint.name} is a slide; a servo turns a hinge"
        if joint.position_range is None or joint.velocity_limit is None:
            yield (
                f"joint {joint.name} needs position_range and velocity_limit: the safety filter keeps to them"
            )
            continue
        ends = sorted(servo.ticks(angle) for angle in joint.position_range)
        if not (0 <= ends[0] and ends[1] < TICKS):
            yield (
                f"joint {joint.name}: its position_range is {ends[0]} to {ends[1]} ticks of its servo, "
                f"which counts 0 to {TICKS - 1}. Check zero and direction; or turn the horn, or set the "
                "servo's homing offset, so that the range does not cross its end"
            )
        low, high = joint.position_range
        if servo.rest is not None and not low <= servo.rest <= high:
            yield f"joint {joint.name}: rest {servo.rest:g} is outside its position_range {low:g} to {high:g}"


HEAD: Final = """\
# The servos. zero: position of the servo [ticks] where the joint's position is 0.  direction: -1 if the
# joint's position falls while the servo's grows.  p_gain, d_gain: registers at the joint's stiffness and
# damping.
"""


def section_lines(section: HardwareSection) -> Iterator[tuple[int, str, Any, str]]:
    """Yield the section's lines for a robot.yaml: indent, name, value, comment."""
    yield 2, "bus", section.bus, "feetech (STS, SMS) or dynamixel (X series)"
    yield 2, "baud_rate", section.baud_rate, "[bit/s]"
    yield 2, "passive", section.passive, "at the end and on a fault. off: no torque; damping: Feetech brakes"
    yield 2, "answer_ms", section.answer_ms, "longest delay of an answer beside its bytes [ms]"
    yield 2, "servos", None, ""
    for servo in section.servos:
        yield 4, "- joint", servo.joint, "as above"
        yield 6, "id", servo.id, "on the bus"
        yield 6, "model", servo.model, 'such as sts3215; "": any'
        yield 6, "zero", servo.zero, "[ticks]"
        yield 6, "direction", servo.direction, "1 or -1"
        yield 6, "rest", servo.rest, "[rad] where the joint may go limp; null for all: no rest pose"
        yield 6, "p_gain", servo.p_gain, "register, at the joint's stiffness"
        yield 6, "d_gain", servo.d_gain, "register, at the joint's damping"
        yield 6, "i_gain", servo.i_gain, "register; an integral hides friction from the recordings"
