"""Demonstration policies (pi_0 in the DEAL paper) in closed loop with simulated robots.

It needs numpy only. The callables fit :data:`deal_hw.sim.recordings.target.Behaviour` and the calibrator's
population policies without importing either. States are those of
:class:`deal_hw.sim.engine.batch.ServoBatch`: a floating base, if any, then the joints.
"""

from __future__ import annotations

from dataclasses import InitVar, dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import PolicyMismatchError, UnknownNameError
from deal_hw.motions.behaviours import ActionMap
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.policy import Observation, ObservationBuilder, PolicySpec
from deal_hw.types import FloatArray

ASSETS: Final = Path(__file__).parent / "assets"
SHIPPED: Final = tuple(sorted(path.name.removesuffix("_udr.onnx") for path in ASSETS.glob("*_udr.onnx")))
"""Robots whose demonstration policy is shipped."""

TARGET_RAD: Final = (0.0, 0.0, 1.0)
"""Target orientation of a demonstration, for policies that observe one: a rotation vector [rad]."""


class BatchPolicy(Protocol):
    """A policy that acts for many members at once."""

    @property
    def spec(self) -> PolicySpec:
        """What the policy observes and what its action means."""
        ...

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, A), for observations, (B, O)."""
        ...


def demonstration_policy(robot: str, checkpoint: Path | None = None) -> OnnxPolicy:
    """Return a policy that demonstrates a robot: its shipped one, or a checkpoint of another training.

    The shipped ones were trained under uniform domain randomisation.

    Raises:
        UnknownNameError: None is shipped; the message lists those that are.
        PolicyError: The checkpoint is no policy.
    """
    if checkpoint is not None:
        return OnnxPolicy(checkpoint)
    if robot not in SHIPPED:
        raise UnknownNameError("robot with a demonstration policy", robot, SHIPPED)
    return OnnxPolicy(ASSETS / f"{robot}_udr.onnx")


def limited_action(
    description: RobotDescription,
    scale: FloatArray,
    action: FloatArray,
    before: FloatArray,
    most: float = 1.0,
) -> FloatArray:
    """Return actions, (..., A), up to ``most``, by which targets move no faster than the limits allow.

    The action itself is limited, so that the policy, which observes its last action, knows what was sent.
    """
    step = np.array(description.limits.target_step) / np.abs(scale)
    return np.clip(np.clip(action, -most, most), before - step, before + step)


@dataclass(eq=False)
class PopulationDemonstration:
    """A policy that drives N robots in closed loop, each from its own state.

    The fields identify it in checkpoints; :meth:`restart` clears the memory of a rollout.

    Attributes:
        policy: The policy.
        description: The robot.
        wanted: Commanded velocity of the base: x, y [m/s] and yaw rate [rad/s], for policies that observe it;
            clipped to the range of their training, as in deploying.
        ran_before: Whether the policy ran before the recordings began; if not, their first command is its
            first.
        spec_digest: Digest of the policy's spec, training record included.

    Raises:
        PolicyMismatchError: The policy was made for another robot, or its network has a memory of its own.
    """

    policy: InitVar[BatchPolicy]
    description: InitVar[RobotDescription]
    wanted: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ran_before: bool = False
    spec_digest: str = ""

    def __post_init__(self, policy: BatchPolicy, description: RobotDescription) -> None:
        spec = policy.spec
        spec.check_fits(description)
        self.spec_digest = spec.digest()
        self._policy, self._description = policy, description
        if spec.recurrent:
            raise PolicyMismatchError(
                "the policy's network has a memory of its own, which no recording holds, so its commands "
                "cannot be computed from states; use a policy without"
            )
        self._map = ActionMap.of_robot(spec, description)

    @property
    def trained_under(self) -> str:
        """Digest of the distribution that the policy was trained under; "" where it is unknown."""
        return self._policy.spec.trained_under

    @property
    def history(self) -> int:
        """Length of the policy's memory [control periods]."""
        return self._policy.spec.history

    def restart(
        self, count: int, position: FloatArray, velocity: FloatArray, command: FloatArray, number: int
    ) -> None:
        """Start N robots from one common past: states (h, C) each, commands (h, A), oldest first.

        Args:
            count: N.
            position: Past positions.
            velocity: Past velocities.
            command: The policy's commands in these states.
            number: Number of its commands so far, including those before this past.
        """
        spec = self._policy.spec
        self._builder = ObservationBuilder(spec, (count,))
        low, high = np.array(spec.command_range or ((-np.inf, np.inf),) * 3).T
        self._builder.command = np.repeat(np.clip(self.wanted, low, high)[None], count, axis=0)
        self._builder.target = np.repeat(np.array(TARGET_RAD)[None], count, axis=0)
        early = number - len(command)
        self._builder.clock = np.full(count, early * spec.clock_hz / spec.control_rate_hz % 1.0)
        self._action = np.zeros((count, len(spec.actuated)))
        for q, v, u in zip(position, velocity, (command - self._map.centre) / self._map.scale, strict=True):
            self._builder.build(*(np.repeat(x[None], count, axis=0) for x in (q, v)))
            self._action = np.repeat(u[None], count, axis=0)
            self._builder.record_action(self._action)

    def __call__(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return the commands of a control period, (N, A), from states, (N, C) each.

        Members with a state that is not finite (diverged ones) get their rest command.
        """
        finite = np.isfinite(np.concatenate([position, velocity], axis=1)).all(axis=1, keepdims=True)
        known = np.nan_to_num(position), np.nan_to_num(velocity)
        observation = self._builder.build(*known)
        wanted = np.where(finite, self._policy.act_batch(observation), 0.0)
        mapped = self._map
        self._action = limited_action(self._description, mapped.scale, wanted, self._action, mapped.limit)
        self._builder.record_action(self._action)
        return mapped.target(self._action)


class Demonstration:
    """The same for one robot, as a target's behaviour: position (C,), velocity (C,), time [s] -> (A,).

    Args:
        policy: The policy.
        description: The robot.
        wanted: See :class:`PopulationDemonstration`.

    Raises:
        PolicyMismatchError: The policy was made for another robot.
    """

    def __init__(
        self,
        policy: BatchPolicy,
        description: RobotDescription,
        wanted: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self._population = PopulationDemonstration(policy, description, wanted)
        self._rate_hz = description.control_rate_hz
        self._actuated = len(description.actuated)

    def __call__(self, position: FloatArray, velocity: FloatArray, time_s: float) -> FloatArray:
        """Return the command of the next control period; time 0 restarts."""
        if round(time_s * self._rate_hz) == 0:
            nothing = np.empty((0, len(position)))
            self._population.restart(1, nothing, nothing, np.empty((0, self._actuated)), 0)
        command: FloatArray = self._population(position[None], velocity[None])[0]
        return command
