"""Contract of a policy: its observation, the meaning of its action, and its robot.

The same code builds observations on the robot and, batched, in training, so that both stay equal.

A spec is checked completely when it is made, in Python or from a file: names, lengths, ranges, finite
numbers.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final, Literal, Protocol, get_args

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, PolicyError, PolicyMismatchError, shown
from deal_hw.rotations import in_base_frame, rotation_between
from deal_hw.schema import SHOWN, STRICT, check_members, check_numbers, either, read_json, refusal
from deal_hw.types import FloatArray, IntArray

Quantity = Literal[
    "position",
    "velocity",
    "sin_position",
    "cos_position",
    "action",
    "gravity",
    "heading",
    "angular_velocity",
    "linear_velocity",
    "height",
    "place",
    "target_rotation",
    "command",
    "clock",
    "joint_target",
    "obstacle",
]
Observation = npt.NDArray[np.float32]

AXES = ("x", "y", "z")
CLOCK_AXES = ("sin", "cos")
OBSTACLE_AXES = ("distance", "height")
BASE_QUANTITIES = ("gravity", "heading", "angular_velocity", "linear_velocity", "height")
"""Observed quantities of a floating base, in the base's frame: the directions of gravity and of the world's x
axis (unit vectors), angular [rad/s] and linear velocity [m/s]; and the base's height [m], whose axis is z."""
WORLD_QUANTITIES = ("place", "target_rotation")
"""Observed quantities of a floating base, in the world: its position [m], which no sensor of a robot
reports, and the rotation vector that turns it to the target orientation [rad]."""
BASE_SIZE = 6
VERDICT: Final = "calibration_verdict"
IMPORTED: Final = "imported"
CLIMBED: Final = "climbed_m"
"""Keys in a training record: the verdict of a calibration or an import; the import; the highest platform that
most robots climbed in training [m]."""
MAX_DELAY: Final = 100
"""Most control periods that an observation may look back: 2 s at 50 Hz."""
MAX_TERMS: Final = 4096
MAX_JOINTS: Final = 256
MAX_SPEC_CHARACTERS: Final = 1_000_000
_OF_ROBOT: Final = (
    "joint_names",
    "actuated",
    "default_position",
    "stiffness",
    "damping",
    "effort_limit",
    "speed_limit",
    "control_rate_hz",
    "position_units",
)
"""Fields of a spec that a robot's description has, too."""
_LATER: Final = (
    "position_units",
    "clock_hz",
    "command_range",
    "action_offset",
    "action_limit",
    "target_range",
    "delayed_commands",
    "clock_rest",
    "recurrent",
)
"""Fields that specs of earlier versions do not have."""


@dataclass(frozen=True, slots=True)
class ObservationTerm:
    """One entry of the observation.

    Attributes:
        quantity: The observed quantity. Positions are relative to the default pose; "action" is a former
            action; "joint_target" is the position that a joint is to reach, relative to the default pose.
            "command" is the requested velocity of the base: x and y [m/s], z [rad/s]. "clock" is a
            phase that turns ``clock_hz`` times a second from the first observation on. "obstacle" is what
            the operator says of a platform ahead: its height, and its distance, which the commanded velocity
            makes smaller. Joint targets and obstacle are the same at all delays; so are command and clock,
            unless the spec says ``delayed_commands``.
        joint: The joint it belongs to; for the base's quantities and the command an axis, x, y or z; for the
            clock "sin" or "cos"; for the obstacle "distance" or "height".
        scale: The factor applied to it [1/unit].
        delay: How many control periods ago, at most :data:`MAX_DELAY`; 0 is now (for actions 1 is the last
            one).

    Raises:
        ConfigurationError: The quantity or axis is unknown, the scale is zero or not finite, or the delay is
            out of range.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    quantity: Quantity
    joint: str
    scale: float
    delay: int = 0

    def __post_init__(self) -> None:
        if self.quantity not in get_args(Quantity):
            raise refusal("quantity", self.quantity, either(get_args(Quantity)))
        if self.axes and self.joint not in self.axes:
            raise refusal("joint", self.joint, f"an axis of {self.quantity!r}: {either(self.axes)}")
        if not math.isfinite(self.scale) or self.scale == 0:
            raise refusal("scale", self.scale, "a finite number that is not 0")
        lowest = 1 if self.quantity == "action" else 0
        if isinstance(self.delay, bool) or not lowest <= self.delay <= MAX_DELAY:
            raise refusal("delay", self.delay, f"{lowest} to {MAX_DELAY} control periods")

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes of the quantity; () for a quantity of joints."""
        if self.quantity == "height":
            return ("z",)
        if self.quantity == "clock":
            return CLOCK_AXES
        if self.quantity == "obstacle":
            return OBSTACLE_AXES
        return AXES if self.quantity in (*BASE_QUANTITIES, *WORLD_QUANTITIES, "command") else ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySpec:
    """The interface of a policy; stored inside the ONNX file.

    Attributes:
        robot: Name of the robot.
        joint_names: The robot's joints in the order the policy was trained with.
        actuated: The joints of the action, in order.
        observation: The terms of the observation, in order.
        action_scale: Position target [m or rad] = centre + scale * action, (A,). Actions are unitless and in
            [-1, 1], unless ``action_limit`` is another.
        default_position: The pose that observation and action are relative to, (J,).
        stiffness: kp sent with each target, (A,).
        damping: kd sent with each target, (A,).
        effort_limit: Effort limit sent with each target, (A,).
        speed_limit: Speed limit sent with each target, (A,).
        control_rate_hz: Rate at which the policy was trained.
        trained_under: Digest of the parameter distribution it was trained under.
        training: Plain JSON values about the training (algorithm, steps, seed, versions).
        position_units: Unit of each joint's position in training, "m" or "rad", (J,); empty: not noted.
        clock_hz: Turns per second of the observed clock; 0: no clock.
        command_range: Lowest and highest velocity command of training, x, y [m/s] and yaw rate [rad/s],
            (3, 2); empty: not noted.
        action_offset: The centre of the targets, (A,) [m or rad]; empty: the robot's default pose. With it
            the policy has poses of its own, and the robot's default pose may be another.
        action_limit: Largest absolute action; larger ones are clipped. Infinite: none is.
        target_range: Lowest and highest target, (A, 2) [m or rad]. Targets are clipped to it, the observed
            action is not; empty: no range.
        delayed_commands: Whether delayed commands and clocks are the former ones.
        clock_rest: Length of a command, (x, y, yaw) as one vector, below which the clock's terms are zero.
        recurrent: Whether the network has a memory of its own between observations.

    Raises:
        ConfigurationError: A field is invalid; the message names the first one.
    """

    __pydantic_config__: ClassVar[Mapping[str, Any]] = STRICT

    robot: str
    joint_names: tuple[str, ...]
    actuated: tuple[str, ...]
    observation: tuple[ObservationTerm, ...]
    action_scale: tuple[float, ...]
    default_position: tuple[float, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    effort_limit: tuple[float, ...]
    speed_limit: tuple[float, ...]
    control_rate_hz: float
    trained_under: str = ""
    training: Mapping[str, Any] = field(default_factory=dict)
    position_units: tuple[str, ...] = ()
    clock_hz: float = 0.0
    command_range: tuple[tuple[float, float], ...] = ()
    action_offset: tuple[float, ...] = ()
    action_limit: float = 1.0
    target_range: tuple[tuple[float, float], ...] = ()
    delayed_commands: bool = False
    clock_rest: float = 0.0
    recurrent: bool = False

    def __post_init__(self) -> None:
        for name, names in (
            ("robot", (self.robot,)),
            ("joint_names", self.joint_names),
            ("actuated", self.actuated),
        ):
            if not 1 <= len(names) <= MAX_JOINTS or not all(names) or len(set(names)) < len(names):
                allowed = f"1 to {MAX_JOINTS} names, all different and none empty"
                raise refusal(name, getattr(self, name), allowed)
        check_members("actuated", self.actuated, self.joint_names)
        check_members("position_units", self.position_units, ("m", "rad"))
        J, A = len(self.joint_names), len(self.actuated)
        check_numbers("action_scale", self.action_scale, A)
        check_numbers("default_position", self.default_position, J)
        for name in ("stiffness", "damping", "effort_limit"):
            check_numbers(name, getattr(self, name), A, lowest=0.0)
        # A robot without a set-point generator has no speed limit.
        check_numbers("speed_limit", self.speed_limit, A, lowest=0.0, endless=True)
        if len(self.position_units) not in (0, J):
            raise refusal("position_units", self.position_units, f"{J} entries, one per joint, or none")
        if not 0 < self.control_rate_hz < math.inf:
            raise refusal("control_rate_hz", self.control_rate_hz, "a finite rate above 0 Hz")
        if not 1 <= len(self.observation) <= MAX_TERMS:
            raise refusal(
                "observation", f"of length {len(self.observation)}", f"1 to {MAX_TERMS}", quote=False
            )
        for i, term in enumerate(self.observation):
            known = self.actuated if term.quantity == "action" else term.axes or self.joint_names
            if term.joint not in known:
                raise refusal(f"observation[{i}].joint", term.joint, either(known))
        self._check_clock()
        if self.action_offset:
            check_numbers("action_offset", self.action_offset, A)
        if not self.action_limit > 0:
            raise refusal("action_limit", self.action_limit, "a number above 0, or Infinity")
        for name, pairs, length in (
            ("command_range", self.command_range, len(AXES)),
            ("target_range", self.target_range, A),
        ):
            if len(pairs) not in (0, length) or not all(
                len(ends) == 2 and -math.inf < ends[0] <= ends[1] < math.inf for ends in pairs
            ):
                allowed = f"{length} pairs (lowest, highest) of finite numbers"
                raise refusal(name, getattr(self, name), allowed)
        try:
            json.dumps(dict(self.training), allow_nan=False)
        except (TypeError, ValueError, RecursionError) as err:
            raise refusal("training", self.training, f"plain JSON values ({err})") from err

    @classmethod
    def of_robot(
        cls,
        description: RobotDescription,
        observation: Iterable[ObservationTerm],
        action_scale: Iterable[float],
        **more: Any,
    ) -> PolicySpec:
        """Return a spec with a robot's joints, default pose, gains, limits and control rate.

        Args:
            description: The robot.
            observation: The terms of the observation.
            action_scale: As the attribute, (A,).
            **more: Further fields, and values other than the robot's.
        """
        own = {name: getattr(description, name) for name in _OF_ROBOT}
        return cls(
            robot=description.name,
            observation=tuple(observation),
            action_scale=tuple(action_scale),
            **{**own, **more},
        )

    def _check_clock(self) -> None:
        observed = any(term.quantity == "clock" for term in self.observation)
        if not 0 <= self.clock_hz < self.control_rate_hz / 2 or observed != (self.clock_hz > 0):
            allowed = (
                f"above 0 and below half the control rate, {self.control_rate_hz / 2:g} Hz"
                if observed
                else "0, as no clock is observed"
            )
            raise refusal("clock_hz", self.clock_hz, allowed)
        if not 0 <= self.clock_rest < math.inf:
            raise refusal("clock_rest", self.clock_rest, "a finite number of at least 0")

    @property
    def observes_base(self) -> bool:
        """Whether the observation needs the state of a floating base."""
        return any(term.quantity in BASE_QUANTITIES + WORLD_QUANTITIES for term in self.observation)

    @property
    def history(self) -> int:
        """How many control periods the observation looks back."""
        return max((term.delay for term in self.observation), default=0)

    def to_json(self) -> str:
        """Return the spec as JSON text."""
        values = {**dataclasses.asdict(self), "training": dict(self.training)}
        # A default stays out: a spec written before the field existed keeps its digest.
        for entry in dataclasses.fields(self):
            if entry.name in _LATER and values[entry.name] == entry.default:
                del values[entry.name]
        return json.dumps(values, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> PolicySpec:
        """Return the spec that :meth:`to_json` wrote.

        Nothing is converted: a number written as text is refused, and so is an unknown field.

        Raises:
            PolicyError: The text is not a policy spec; the message names the fields.
        """
        if len(text) > MAX_SPEC_CHARACTERS:
            raise PolicyError(
                f"not a policy spec: {len(text)} characters; allowed: at most {MAX_SPEC_CHARACTERS}"
            )
        try:
            return read_json(cls, text)
        except ConfigurationError as err:
            raise PolicyError(f"not a policy spec: {err}") from err

    def digest(self) -> str:
        """Return a digest of the spec."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()[:16]

    def check_fits(self, description: RobotDescription) -> None:
        """Check that the policy was made for this robot.

        Raises:
            PolicyMismatchError: It was made for another robot; the message names every field that differs.
        """
        own_choice = {
            name
            for name, free in (
                ("position_units", not self.position_units),
                # The policy's own poses are inside its targets and observations.
                ("default_position", bool(self.action_offset)),
            )
            if free
        }
        wrong = {
            name: f"policy has {shown(given)}, robot has {shown(own)}"
            for name, (given, own) in {
                "robot": (self.robot, description.name),
                "joint_names": (self.joint_names, description.joint_names),
                "actuated": (self.actuated, description.actuated),
                "position_units": (self.position_units, description.position_units),
                "default_position": (self.default_position, description.default_position),
                "control_rate_hz": (self.control_rate_hz, description.control_rate_hz),
            }.items()
            if given != own and name not in own_choice
        }
        limits = description.limits
        for name, allowed in (
            ("stiffness", limits.stiffness),
            ("damping", limits.damping),
            ("effort_limit", limits.effort),
            ("speed_limit", limits.speed),
        ):
            given = getattr(self, name)
            if len(given) != len(allowed) or any(g > a for g, a in zip(given, allowed, strict=True)):
                wrong[name] = f"policy requests {shown(given)}, the robot allows at most {shown(allowed)}"
        if wrong:
            listed = "; ".join(f"{name}: {words}" for name, words in list(wrong.items())[:SHOWN])
            others = "; also: " + ", ".join(list(wrong)[SHOWN:]) if len(wrong) > SHOWN else ""
            raise PolicyMismatchError(
                f"the policy does not fit the robot: {listed}{others}; give a policy that was trained for "
                f"{description.name!r}"
            )


class Policy(Protocol):
    """A policy: observation in, unitless action out."""

    @property
    def spec(self) -> PolicySpec:
        """The policy's interface."""
        ...

    def reset(self) -> None:
        """Clear the memory."""
        ...

    def act(self, observation: Observation) -> FloatArray:
        """Return the action, (A,), for an observation, (O,). Actions are clipped to [-1, 1] by the caller."""
        ...


class ObservationBuilder:
    """Builds observations, for one robot or for a batch of B simulated ones.

    Args:
        spec: The policy's spec.
        batch_shape: () on the robot, (B,) in training.

    Attributes:
        command: The requested velocity of the base: x, y [m/s] and yaw rate [rad/s], (..., 3); zero at first.
        clock: Phase of the clock at the next observation, (...,) [turns]; zero at first and after a reset.
        target: The requested orientation of the base as a rotation vector around the identity, (..., 3)
            [rad]; zero at first.
        joint_target: The positions that the joints are to reach, (..., J); the default pose at first.
        obstacle: Distance and height of a platform ahead, as the operator says, (..., 2) [m]; zero at first
            and where nothing is said. After each observation the distance is less by the commanded way.
    """

    def __init__(self, spec: PolicySpec, batch_shape: tuple[int, ...] = ()) -> None:
        self.spec = spec
        self._default = np.asarray(spec.default_position)
        depth = spec.history + 1
        J, A = len(spec.joint_names), len(spec.actuated)
        self._position = np.zeros((depth, *batch_shape, J))
        self._velocity = np.zeros((depth, *batch_shape, J))
        self._action = np.zeros((depth + 1, *batch_shape, A))
        self._base = np.zeros((depth, *batch_shape, 4 * len(AXES) + 1))
        self._world = np.zeros((depth, *batch_shape, 2 * len(AXES)))
        self.command: FloatArray = np.zeros((*batch_shape, len(AXES)))
        self.target: FloatArray = np.zeros((*batch_shape, len(AXES)))
        self.joint_target: FloatArray = np.broadcast_to(self._default, (*batch_shape, J)).copy()
        self.obstacle: FloatArray = np.zeros((*batch_shape, len(OBSTACLE_AXES)))
        self.clock: FloatArray = np.zeros(batch_shape)
        # Without delays of their own, command and clock are read as they are now.
        memory = depth if spec.delayed_commands else 1
        self._command = np.zeros((memory, *batch_shape, len(AXES)))
        self._clock = np.zeros((memory, *batch_shape, len(CLOCK_AXES)))
        self._fresh = np.ones(batch_shape, dtype=bool)
        self._reads = _reads(spec)

    @property
    def size(self) -> int:
        """Length O of an observation."""
        return len(self.spec.observation)

    def reset(self, where: npt.NDArray[np.bool_] | None = None) -> None:
        """Clear the memory of the batch members in ``where`` (all by default)."""
        mask = np.ones(self._fresh.shape, dtype=bool) if where is None else where
        self._fresh = self._fresh | mask
        self._action[:, mask] = 0.0
        self.clock = np.where(mask, 0.0, self.clock)

    def record_action(self, action: FloatArray) -> None:
        """Note the action that was taken after the last observation, (..., A)."""
        self._shift(self._action)
        self._action[1] = action

    def build(self, position: FloatArray, velocity: FloatArray) -> Observation:
        """Return the observation, (..., O).

        Args:
            position: Joint positions, (..., J); with a floating base, which then comes first, (..., 6 + J):
                position in the world and rotation vector around the identity
                (:mod:`deal_hw.sim.engine.tangent_coordinates`).
            velocity: Their velocities: linear in the world, angular in the base's frame, joints.

        Raises:
            ConfigurationError: The policy observes the base, which is not given.
        """
        J = len(self._default)
        past = [self._position, self._velocity, self._command, self._clock]
        self._shift(self._position)
        self._shift(self._velocity)
        self._position[0] = position[..., -J:] - self._default
        self._velocity[0] = velocity[..., -J:]
        self._shift(self._command)
        self._command[0] = self.command
        self._shift(self._clock)
        self._clock[0] = self._hands()
        if self.spec.observes_base:
            if position.shape[-1] != BASE_SIZE + J:
                raise ConfigurationError(
                    f"the policy for {self.spec.robot!r} observes the base and needs {BASE_SIZE} + {J} "
                    f"coordinates, got {position.shape[-1]}; this robot's states do not contain the base: "
                    "use another policy"
                )
            past += [self._base, self._world]
            self._shift(self._base)
            self._base[0] = base_features(position[..., :BASE_SIZE], velocity[..., :BASE_SIZE])
            self._shift(self._world)
            self._world[0, ..., :3] = position[..., :3]
            self._world[0, ..., 3:] = rotation_between(position[..., 3:BASE_SIZE], self.target)
        if self._fresh.any():
            # The history of a new member is filled with its present state, because it has no past.
            for memory in past:
                np.copyto(memory, memory[:1], where=self._fresh[..., None])
            self._fresh = np.zeros_like(self._fresh)
        found = np.empty((*self._fresh.shape, self.size), dtype=np.float32)
        for read in self._reads:
            values = self._memory(read.quantity)[read.delay, ..., read.column]
            found[..., read.entry] = read.scale * np.moveaxis(values, 0, -1)
        self.clock = (self.clock + self.spec.clock_hz / self.spec.control_rate_hz) % 1.0
        way = self.command[..., 0] / self.spec.control_rate_hz
        self.obstacle[..., 0] -= np.where(self.obstacle[..., 1] != 0.0, way, 0.0)
        return found

    def _hands(self) -> FloatArray:
        """Return sine and cosine of the clock's phase, (..., 2)."""
        angle = 2.0 * np.pi * self.clock
        hands = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        if self.spec.clock_rest > 0:
            resting = np.linalg.norm(self.command, axis=-1, keepdims=True) < self.spec.clock_rest
            hands = np.where(resting, 0.0, hands)
        return np.asarray(hands)

    @staticmethod
    def _shift(memory: FloatArray) -> None:
        memory[1:] = memory[:-1]

    def _memory(self, quantity: Quantity) -> FloatArray:
        """Return what a quantity is read from, (delays, ..., columns)."""
        # There is no default: a quantity without a case cannot be observed.
        match quantity:
            case "position":
                return self._position
            case "sin_position":
                return np.asarray(np.sin(self._position))
            case "cos_position":
                return np.asarray(np.cos(self._position))
            case "velocity":
                return self._velocity
            case "action":
                return self._action
            case "command":
                return self._command
            case "clock":
                return self._clock
            case "joint_target":
                return np.asarray((self.joint_target - self._default)[None])
            case "obstacle":
                return self.obstacle[None]
            case "place" | "target_rotation":
                return self._world
            case "gravity" | "heading" | "angular_velocity" | "linear_velocity" | "height":
                return self._base


@dataclass(frozen=True, slots=True)
class _Read:
    """The terms of one quantity: indices of their delays, columns and entries of the observation, (n,)."""

    quantity: Quantity
    delay: IntArray
    column: IntArray
    entry: IntArray
    scale: FloatArray


def _reads(spec: PolicySpec) -> list[_Read]:
    entries: dict[Quantity, list[int]] = {}
    for entry, term in enumerate(spec.observation):
        entries.setdefault(term.quantity, []).append(entry)
    return [
        _Read(
            quantity,
            np.array(
                [
                    0
                    if quantity in ("joint_target", "obstacle")
                    or (quantity in ("command", "clock") and not spec.delayed_commands)
                    else spec.observation[i].delay
                    for i in found
                ]
            ),
            np.array([_column(spec, spec.observation[i]) for i in found]),
            np.array(found),
            np.array([spec.observation[i].scale for i in found]),
        )
        for quantity, found in entries.items()
    ]


def _column(spec: PolicySpec, term: ObservationTerm) -> int:
    if not term.axes:
        return (spec.actuated if term.quantity == "action" else spec.joint_names).index(term.joint)
    together = BASE_QUANTITIES if term.quantity in BASE_QUANTITIES else WORLD_QUANTITIES
    first = len(AXES) * together.index(term.quantity) if term.quantity in together else 0
    return first + term.axes.index(term.joint)


def base_features(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the observed quantities of a base, (..., 13), in the order of :data:`BASE_QUANTITIES`.

    Args:
        position: Position in the world and rotation vector, (..., 6).
        velocity: Linear in the world, angular in the base's frame, (..., 6).
    """
    turn = position[..., 3:]
    down, ahead = (np.broadcast_to(v, turn.shape) for v in (np.array([0.0, 0, -1]), np.array([1.0, 0, 0])))
    vectors = np.stack([down, ahead, velocity[..., :3]], axis=-2)
    seen = in_base_frame(turn[..., None, :], vectors)
    return np.concatenate(
        [seen[..., 0, :], seen[..., 1, :], velocity[..., 3:], seen[..., 2, :], position[..., 2:3]],
        axis=-1,
    )
