"""What an exported policy says of itself, in one form for all formats, and the spec that follows from it.

Units are those of robots: metres, radians, seconds, newtons. Joints have the robot's names. Their order is
the network's, in observations as in actions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, PolicyMismatchError
from deal_hw.policy import AXES, CLOCK_AXES, ObservationTerm, PolicySpec, Quantity
from deal_hw.schema import either

MOST_HISTORY: Final = 100
"""Most former values of a term; a spec looks back no further."""
_ANYWHERE: Final = (-1e6, 1e6)
"""Range of a target without one, beside joints that have one."""
AXES_OF: Final[Mapping[Quantity, tuple[str, ...]]] = {
    "gravity": AXES,
    "angular_velocity": AXES,
    "command": AXES,
    "clock": CLOCK_AXES,
}
"""Elements of the quantities that belong to no joint."""
UNMEASURED: Final[Mapping[str, str]] = {
    "base_lin_vel": "the base's linear velocity",
    "lin_vel": "the base's linear velocity",
    "base_height": "the base's height",
    "height_scan": "heights of the ground",
    "foot_contact": "contacts of the feet",
    "foot_height": "heights of the feet",
}
"""Terms that simulators have and robots do not measure, and what they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignJoint:
    """One joint: its pose that positions are relative to, and the gains sent with its targets."""

    name: str
    default: float
    stiffness: float
    damping: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignAction:
    """One output of the network: target = offset + scale * output, clipped to the range if there is one."""

    joint: str
    scale: float
    offset: float
    range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignTerm:
    """One term of the observation.

    Attributes:
        name: Its name in the format.
        quantity: What it observes.
        elements: The joints or axes, in order.
        scale: A factor for each element.
        clip: Lowest and highest value before the factor, or after it with ``scale_first``; None for none.
        scale_first: Whether the value is clipped after the factor.
        history: Number of values, the present one included.
    """

    name: str
    quantity: Quantity
    elements: tuple[str, ...]
    scale: tuple[float, ...]
    clip: tuple[float, float] | None = None
    scale_first: bool = False
    history: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignPolicy:
    """A policy as its format describes it.

    Attributes:
        format: Name of the format.
        joints: All joints that it sends targets to, or observes.
        actions: The network's outputs, in order. Joints without one keep their default position.
        terms: The terms of the observation, in order, each with its values from the oldest to the present.
        frames: Whether the observation has all terms of the oldest moment first, and those of the present
            last.
        control_rate_hz: Rate at which it was trained.
        command_range: Lowest and highest velocity command, x, y [m/s] and yaw rate [rad/s], (3, 2).
        clock_hz: Turns per second of an observed clock; 0: none.
        clock_rest: Length of a command below which the clock reads zero.
        notes: What the operator should know, as sentences.
    """

    format: str
    joints: tuple[ForeignJoint, ...]
    actions: tuple[ForeignAction, ...]
    terms: tuple[ForeignTerm, ...]
    frames: bool = False
    control_rate_hz: float
    command_range: tuple[tuple[float, float], ...]
    clock_hz: float = 0.0
    clock_rest: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def observations(self) -> int:
        """Length of the observation."""
        return sum(len(term.elements) * term.history for term in self.terms)

    def entries(self) -> list[tuple[ObservationTerm, tuple[float, float]]]:
        """Return the entries of the observation, and between which values the network wants each."""
        if self.frames and len({term.history for term in self.terms}) > 1:
            raise ConfigurationError(
                f"{self.format}: a history of whole frames needs the same history_length in all terms, found "
                + ", ".join(f"{term.name} {term.history}" for term in self.terms)
            )
        blocks = [(term, age) for term in self.terms for age in reversed(range(term.history))]
        if self.frames:
            blocks.sort(key=lambda block: -block[1])
        return [
            (_entry(term, element, scale, age), _ends(term, scale))
            for term, age in blocks
            for element, scale in zip(term.elements, term.scale, strict=True)
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Adapter:
    """How a network of another trainer becomes one for a robot.

    Attributes:
        lowest: Lowest value of each entry of the observation, (O,); -inf for none.
        highest: Highest value, (O,).
        outputs: Which of the network's outputs is the action of each of the robot's actuated joints, (A,);
            -1: none, the action is 0.
        count: Number of the network's outputs.
    """

    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    outputs: tuple[int, ...]
    count: int


def adapter_of(policy: ForeignPolicy, description: RobotDescription) -> Adapter:
    """Return what turns the network's inputs and outputs into a robot's."""
    ends = [span for _, span in policy.entries()]
    driven = [action.joint for action in policy.actions]
    return Adapter(
        lowest=tuple(low for low, _ in ends),
        highest=tuple(high for _, high in ends),
        outputs=tuple(driven.index(name) if name in driven else -1 for name in description.actuated),
        count=len(driven),
    )


def spec_of(
    policy: ForeignPolicy, description: RobotDescription, *, recurrent: bool, training: Mapping[str, Any]
) -> PolicySpec:
    """Return the spec of a policy on a robot.

    Args:
        policy: The policy.
        description: The robot, as its driver describes it.
        recurrent: Whether its network has a memory.
        training: The record for the spec.

    Raises:
        PolicyMismatchError: The robot has other joints.
        ConfigurationError: A value is out of its range; the message names the field of the spec.
    """
    _check_joints(policy, description)
    joints = {joint.name: joint for joint in policy.joints}
    actions = {action.joint: action for action in policy.actions}
    defaults = dict(zip(description.joint_names, description.default_position, strict=True))
    defaults.update({joint.name: joint.default for joint in policy.joints})
    offsets = {name: action.offset for name, action in actions.items()}
    ranges = {name: action.range for name, action in actions.items() if action.range is not None}
    terms = tuple(entry for entry, _ in policy.entries())
    return PolicySpec.of_robot(
        description,
        terms,
        [actions[name].scale if name in actions else 1.0 for name in description.actuated],
        default_position=tuple(defaults[name] for name in description.joint_names),
        action_offset=tuple(offsets.get(name, defaults[name]) for name in description.actuated),
        action_limit=math.inf,
        target_range=tuple(ranges.get(name, _ANYWHERE) for name in description.actuated) if ranges else (),
        stiffness=tuple(joints[name].stiffness for name in description.actuated),
        damping=tuple(joints[name].damping for name in description.actuated),
        effort_limit=tuple(map(min, description.effort_limit, description.limits.effort)),
        control_rate_hz=policy.control_rate_hz,
        command_range=policy.command_range,
        clock_hz=policy.clock_hz,
        clock_rest=policy.clock_rest,
        delayed_commands=any(t.quantity in ("command", "clock") and t.history > 1 for t in policy.terms),
        recurrent=recurrent,
        training=training,
    )


def unmeasured(term: str, robot: str) -> PolicyMismatchError:
    """Return the error for a term that no sensor of the robot measures."""
    return PolicyMismatchError(
        f"the policy observes {term!r}, {UNMEASURED[term]}, which no sensor of {robot!r} measures; train it "
        "without this term (the critic may keep it), or with an estimate inside the network"
    )


def quantity_of(term: str, known: Mapping[str, Quantity], format: str, robot: str) -> Quantity:
    """Return what a term observes.

    Args:
        term: Its name.
        known: The format's terms.
        format: The format, for the message.
        robot: The robot's name, for the message.

    Raises:
        PolicyMismatchError: No sensor of the robot measures it.
        ConfigurationError: It is not known.
    """
    if term in UNMEASURED:
        raise unmeasured(term, robot)
    if term not in known:
        raise ConfigurationError(
            f"{format}: observation term {term!r} is unknown; known are {either(sorted(known))}; train "
            "without it, or tell its meaning to the project"
        )
    return known[term]


def joints_of(
    names: Sequence[str], default: Sequence[float], stiffness: Sequence[float], damping: Sequence[float]
) -> tuple[ForeignJoint, ...]:
    """Return joints from one list for each of their values."""
    return tuple(
        ForeignJoint(name=name, default=pose, stiffness=kp, damping=kd)
        for name, pose, kp, kd in zip(names, default, stiffness, damping, strict=True)
    )


def actions_around(
    names: Sequence[str], default: Sequence[float], scale: Sequence[float]
) -> tuple[ForeignAction, ...]:
    """Return actions that are offsets from the default pose."""
    return tuple(
        ForeignAction(joint=name, scale=factor, offset=pose)
        for name, pose, factor in zip(names, default, scale, strict=True)
    )


def check_history(term: str, history: int) -> int:
    """Return the number of a term's values.

    Raises:
        ConfigurationError: It is out of range.
    """
    if not 1 <= history <= MOST_HISTORY:
        raise ConfigurationError(f"term {term!r}: history {history}; allowed are 1 to {MOST_HISTORY}")
    return history


def _entry(term: ForeignTerm, element: str, scale: float, age: int) -> ObservationTerm:
    # The last action is the one of the control period before.
    delay = age + 1 if term.quantity == "action" else age
    return ObservationTerm(term.quantity, element, scale, delay)


def _ends(term: ForeignTerm, scale: float) -> tuple[float, float]:
    if term.clip is None:
        return -math.inf, math.inf
    factor = 1.0 if term.scale_first else scale
    low, high = sorted(factor * end for end in term.clip)
    return low, high


def _check_joints(policy: ForeignPolicy, description: RobotDescription) -> None:
    names = [joint.name for joint in policy.joints]
    known, given = set(description.joint_names), set(names)
    twice = sorted({name for name in names if names.count(name) > 1})
    missing = [name for name in description.actuated if name not in given]
    foreign = [name for name in names if name not in known]
    wrong = [
        f"{what} {', '.join(found)}"
        for what, found in (
            ("named twice:", twice),
            (f"not of {description.name!r}:", foreign),
            ("missing:", missing),
        )
        if found
    ]
    if wrong:
        raise PolicyMismatchError(
            f"the policy's joints do not fit robot {description.name!r}: {'; '.join(wrong)}; the robot has "
            f"{', '.join(description.joint_names)}: choose the right robot (--robot), or name the policy's "
            "joints in its own order by the robot's names (--joints)"
        )
