"""Contract of a policy: what it observes, what its action means, and for which robot it was made.

The same code builds observations on the robot and, batched, in training, so that the two cannot drift apart.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, PolicyError, PolicyMismatchError
from deal_hw.types import FloatArray

Quantity = Literal[
    "position", "velocity", "sin_position", "cos_position", "action",
    "gravity", "heading", "angular_velocity", "linear_velocity", "height", "command",
]  # fmt: skip
Observation = npt.NDArray[np.float32]

AXES = ("x", "y", "z")
BASE_QUANTITIES = ("gravity", "heading", "angular_velocity", "linear_velocity", "height")
"""What a floating base adds, in the base's frame: the directions of gravity and of the world's x axis (unit
vectors), angular [rad/s] and linear velocity [m/s]; and the base's height [m], whose axis is z."""
BASE_SIZE = 6


@dataclass(frozen=True, slots=True)
class ObservationTerm:
    """One entry of the observation.

    Attributes:
        quantity: What is observed. Positions are relative to the default pose; "action" is a former action;
            "command" is the wanted velocity of the base: x and y [m/s], z [rad/s], the same at all delays.
        joint: The joint it belongs to; for the base's quantities and the command an axis, x, y or z.
        scale: The factor applied to it [1/unit].
        delay: How many control periods ago; 0 is now (for actions 1 is the last one).
    """

    quantity: Quantity
    joint: str
    scale: float
    delay: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PolicySpec:
    """What a policy needs to know and to be given; travels inside the ONNX file.

    Attributes:
        robot: Name of the robot.
        joint_names: The robot's joints in the order the policy was trained with.
        actuated: The joints of the action, in order.
        observation: The terms of the observation, in order.
        action_scale: Position target [m or rad] = default + scale * action, (A,). Actions are unitless in
            [-1, 1].
        default_position: The pose that observation and action are relative to, (J,).
        stiffness: kp sent with each target, (A,).
        damping: kd sent with each target, (A,).
        effort_limit: Effort limit sent with each target, (A,).
        speed_limit: Speed limit sent with each target, (A,).
        control_rate_hz: Rate at which the policy was trained.
        trained_under: Digest of the parameter distribution it was trained under.
        training: Plain JSON values about the training (algorithm, steps, seed, versions).
    """

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

    def __post_init__(self) -> None:
        for term in self.observation:
            of_base = term.quantity in (*BASE_QUANTITIES, "command")
            known = ("z",) if term.quantity == "height" else AXES if of_base else self.joint_names
            if term.joint not in known:
                raise ConfigurationError(
                    f"observation term {term} names {'axis' if of_base else 'joint'} {term.joint!r}; "
                    f"known: {known}"
                )
            lowest = 1 if term.quantity == "action" else 0
            if term.delay < lowest:
                raise ConfigurationError(f"observation term {term}: delay must be at least {lowest}")

    @property
    def observes_base(self) -> bool:
        """Whether the observation needs the state of a floating base."""
        return any(term.quantity in BASE_QUANTITIES for term in self.observation)

    @property
    def history(self) -> int:
        """How many control periods the observation looks back."""
        return max((term.delay for term in self.observation), default=0)

    def to_json(self) -> str:
        """Return the spec as JSON text."""
        return json.dumps({**dataclasses.asdict(self), "training": dict(self.training)}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> PolicySpec:
        """Return the spec that :meth:`to_json` wrote.

        Raises:
            PolicyError: The text is not a policy spec.
        """
        try:
            values = json.loads(text)
            values["observation"] = tuple(ObservationTerm(**term) for term in values["observation"])
            for name, value in values.items():
                if isinstance(value, list):
                    values[name] = tuple(value)
            return cls(**values)
        except (ValueError, TypeError, KeyError, AttributeError) as err:
            raise PolicyError(f"not a policy spec: {err}") from err

    def digest(self) -> str:
        """Return a digest of the spec."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()[:16]

    def check_fits(self, description: RobotDescription) -> None:
        """Check that the policy was made for this robot.

        Raises:
            PolicyMismatchError: It was not; the message names every field that differs.
        """
        pairs = {
            "robot": (self.robot, description.name),
            "joint_names": (self.joint_names, description.joint_names),
            "actuated": (self.actuated, description.actuated),
            "default_position": (self.default_position, description.default_position),
            "control_rate_hz": (self.control_rate_hz, description.control_rate_hz),
        }
        wrong = [f"{k}: policy has {a!r}, robot has {b!r}" for k, (a, b) in pairs.items() if a != b]
        limits = description.limits
        for name, allowed in (
            ("stiffness", limits.stiffness), ("damping", limits.damping), ("effort_limit", limits.effort),
            ("speed_limit", limits.speed),
        ):  # fmt: skip
            given = getattr(self, name)
            if len(given) != len(allowed) or any(
                g > a or not g >= 0 for g, a in zip(given, allowed, strict=False)
            ):
                wrong.append(f"{name}: policy asks for {given!r}, the robot allows at most {allowed!r}")
        if wrong:
            raise PolicyMismatchError("the policy does not fit the robot: " + "; ".join(wrong))


class Policy(Protocol):
    """A policy: observation in, unitless action out."""

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        ...

    def reset(self) -> None:
        """Forget everything about the past."""
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
        command: The wanted velocity of the base: x, y [m/s] and yaw rate [rad/s], (..., 3); zero at first.
    """

    def __init__(self, spec: PolicySpec, batch_shape: tuple[int, ...] = ()) -> None:
        self.spec = spec
        self._joint = {name: i for i, name in enumerate(spec.joint_names)}
        self._actuator = {name: i for i, name in enumerate(spec.actuated)}
        self._default = np.asarray(spec.default_position)
        depth = spec.history + 1
        J, A = len(spec.joint_names), len(spec.actuated)
        self._position = np.zeros((depth, *batch_shape, J))
        self._velocity = np.zeros((depth, *batch_shape, J))
        self._action = np.zeros((depth + 1, *batch_shape, A))
        self._base = np.zeros((depth, *batch_shape, 4 * len(AXES) + 1))
        self.command: FloatArray = np.zeros((*batch_shape, len(AXES)))
        self._fresh = np.ones(batch_shape, dtype=bool)

    @property
    def size(self) -> int:
        """Length O of an observation."""
        return len(self.spec.observation)

    def reset(self, where: npt.NDArray[np.bool_] | None = None) -> None:
        """Forget the past of the members of the batch in ``where`` (all by default)."""
        mask = np.ones(self._fresh.shape, dtype=bool) if where is None else where
        self._fresh = self._fresh | mask
        self._action[:, mask] = 0.0

    def record_action(self, action: FloatArray) -> None:
        """Note the action that was taken after the last observation, (..., A)."""
        self._action = np.roll(self._action, 1, axis=0)
        self._action[1] = action

    def build(self, position: FloatArray, velocity: FloatArray) -> Observation:
        """Return the observation, (..., O).

        Args:
            position: Joint positions, (..., J); with a floating base, which then comes first, (..., 6 + J):
                position in the world and rotation vector (:mod:`deal_hw.sim.chart`, around the identity).
            velocity: Their velocities: linear in the world, angular in the base's frame, joints.

        Raises:
            ConfigurationError: The policy observes the base, and it is not given.
        """
        J = len(self._default)
        self._position = np.roll(self._position, 1, axis=0)
        self._velocity = np.roll(self._velocity, 1, axis=0)
        self._position[0] = position[..., -J:] - self._default
        self._velocity[0] = velocity[..., -J:]
        if self.spec.observes_base:
            if position.shape[-1] != BASE_SIZE + J:
                raise ConfigurationError(
                    f"the policy for {self.spec.robot!r} observes the base: it needs {BASE_SIZE} + {J} "
                    f"coordinates, got {position.shape[-1]}; this robot's states carry no base"
                )
            self._base = np.roll(self._base, 1, axis=0)
            self._base[0] = base_features(position[..., :BASE_SIZE], velocity[..., :BASE_SIZE])
            self._base = np.where(self._fresh[..., None], self._base[:1], self._base)
        # The past of a fresh member is its present: there is no other state to fill it with.
        fresh = self._fresh[..., None]
        self._position = np.where(fresh, self._position[:1], self._position)
        self._velocity = np.where(fresh, self._velocity[:1], self._velocity)
        self._fresh = np.zeros_like(self._fresh)
        columns = [self._term(term) for term in self.spec.observation]
        return np.stack(columns, axis=-1).astype(np.float32)

    def _term(self, term: ObservationTerm) -> FloatArray:
        if term.quantity == "action":
            return np.asarray(term.scale * self._action[term.delay][..., self._actuator[term.joint]])
        if term.quantity == "command":
            return np.asarray(term.scale * self.command[..., AXES.index(term.joint)])
        if term.quantity in BASE_QUANTITIES:
            first = len(AXES) * BASE_QUANTITIES.index(term.quantity)
            offset = 0 if term.quantity == "height" else AXES.index(term.joint)
            return np.asarray(term.scale * self._base[term.delay][..., first + offset])
        source = self._velocity if term.quantity == "velocity" else self._position
        value = source[term.delay][..., self._joint[term.joint]]
        if term.quantity == "sin_position":
            value = np.sin(value)
        elif term.quantity == "cos_position":
            value = np.cos(value)
        return np.asarray(term.scale * value)


def in_base_frame(rotation_vector: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors of the world, (..., 3), in the frame of a base at rotation vectors, (..., 3).

    Rodrigues' formula for the inverse rotation.
    """
    angle = np.linalg.norm(rotation_vector, axis=-1, keepdims=True)
    axis = rotation_vector / np.where(angle > 0, angle, 1.0)
    along = np.sum(axis * vector, axis=-1, keepdims=True)
    turned = np.cos(angle) * vector - np.sin(angle) * np.cross(axis, vector)
    return np.asarray(turned + (1.0 - np.cos(angle)) * along * axis)


def rotation_vector(quaternion: FloatArray) -> FloatArray:
    """Return the rotation vector, (3,) [rad], of an orientation, (4,), a unit quaternion wxyz."""
    w, v = float(quaternion[0]), quaternion[1:]
    sine = float(np.linalg.norm(v))
    # Of the two quaternions of a rotation, the one with the smaller angle.
    angle = 2.0 * math.atan2(sine, abs(w))
    return np.asarray(v * (math.copysign(1.0, w) * (angle / sine if sine > 0 else 2.0)))


def base_features(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return what is observed of a base, (..., 13), in the order of :data:`BASE_QUANTITIES`.

    Args:
        position: Position in the world and rotation vector, (..., 6).
        velocity: Linear in the world, angular in the base's frame, (..., 6).
    """
    turn = position[..., 3:]
    down, ahead = (np.broadcast_to(v, turn.shape) for v in (np.array([0.0, 0, -1]), np.array([1.0, 0, 0])))
    return np.concatenate(
        [
            in_base_frame(turn, down), in_base_frame(turn, ahead), velocity[..., 3:],
            in_base_frame(turn, velocity[..., :3]), position[..., 2:3],
        ],
        axis=-1,
    )  # fmt: skip
