"""Contract of a policy: what it observes, what its action means, and for which robot it was made.

The same code builds observations on the robot and, batched, in training, so that the two cannot drift apart.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, PolicyError, PolicyMismatchError
from deal_hw.types import FloatArray

Quantity = Literal["position", "velocity", "sin_position", "cos_position", "action"]
Observation = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ObservationTerm:
    """One entry of the observation.

    Attributes:
        quantity: What is observed. Positions are relative to the default pose; "action" is a former action.
        joint: The joint it belongs to.
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
            if term.joint not in self.joint_names:
                raise ConfigurationError(
                    f"observation term {term} names joint {term.joint!r}; known: {self.joint_names}"
                )
            lowest = 1 if term.quantity == "action" else 0
            if term.delay < lowest:
                raise ConfigurationError(f"observation term {term}: delay must be at least {lowest}")

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
        """Return the observation, (..., O), from joint positions and velocities, (..., J) each."""
        self._position = np.roll(self._position, 1, axis=0)
        self._velocity = np.roll(self._velocity, 1, axis=0)
        self._position[0] = position - self._default
        self._velocity[0] = velocity
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
        source = self._velocity if term.quantity == "velocity" else self._position
        value = source[term.delay][..., self._joint[term.joint]]
        if term.quantity == "sin_position":
            value = np.sin(value)
        elif term.quantity == "cos_position":
            value = np.cos(value)
        return np.asarray(term.scale * value)
