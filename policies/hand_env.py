"""The Allegro hand's task: turn a cube on the palm to a target orientation."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.locomotion import LocomotionEnv, joint_terms, locomotion_spec, vector_terms
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import check_task
from deal_hw.policy import Observation, PolicySpec
from deal_hw.rotations import rotation_between
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray

_UP = 2
"""Axis of the world's vertical."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TurnTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        largest_turn_rad: Largest rotation of a target about the vertical, to either side.
        tolerance_rad: Rotation from the target within which the cube counts as aligned.
        progress_weight: Reward of each radian by which the cube comes closer to the target [1/rad].
        aligned_weight: Reward of a tick with the cube at the target; at ``tolerance_rad`` it is half of it.
        holding_reward: Reward of a tick with the cube on the hand.
        shift_weight: Cost of the squared distance of the cube from its place at the start, in the palm's
            plane [1/m²].
        control_weight: Cost of the sum of squared actions.
        action_weight: Cost of the squared change of the action.
        drop_cost: Cost of dropping the cube.
        spread_rad: Joint offset from the holding pose at action 1, of the joints that spread the fingers.
        bend_rad: The same of those that bend them.
        least_height_m: Height below which the cube has fallen off.
        start_noise_rad: Largest deviation of joints at the start.
    """

    ticks: int = 400
    largest_turn_rad: float = math.pi / 2
    tolerance_rad: float = 0.4
    progress_weight: float = 20.0
    aligned_weight: float = 1.0
    holding_reward: float = 0.1
    shift_weight: float = 50.0
    control_weight: float = 0.005
    action_weight: float = 0.005
    drop_cost: float = 10.0
    spread_rad: float = 0.5
    bend_rad: float = 0.8
    least_height_m: float = 0.02
    start_noise_rad: float = 0.05

    def __post_init__(self) -> None:
        check_task(self, "largest_turn_rad", "tolerance_rad", "spread_rad", "bend_rad")


def turn_spec(
    description: RobotDescription, trained_under: str = "", task: TurnTask | None = None
) -> PolicySpec:
    """Return the layout of observation and action: the cube and its target, joints, last action."""
    task = task or TurnTask()
    terms = [*vector_terms("place", 20.0), *vector_terms("target_rotation", 1.0)]
    terms += [*vector_terms("gravity", 1.0), *vector_terms("heading", 1.0)]
    terms += [*vector_terms("linear_velocity", 5.0), *vector_terms("angular_velocity", 0.2)]
    terms += joint_terms(description, 0.1)
    scale = [task.spread_rad if name.endswith("_0") else task.bend_rad for name in description.actuated]
    return locomotion_spec(description, terms, scale, trained_under)


class HandEnv(LocomotionEnv):
    """Turn the cube to a target orientation on the hand; an episode ends when it falls off.

    A target is the orientation at the start, turned about the vertical by an angle that is drawn uniformly.
    With the angle e from the target, from the true state, the reward of a tick is::

        progress_weight (e_before - e) + aligned_weight / (1 + e / tolerance_rad) + holding_reward
        - shift_weight (dx² + dy²) - control_weight |a|² - action_weight |a - a_before|²

    and -drop_cost in the tick in which the cube falls off. The paper's task is to align an object with a
    target orientation; it does not say how the targets are drawn.

    Args:
        description: The hand; the cube is its floating base.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
    """

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: TurnTask | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task = task or TurnTask()
        self.failure_reward = -task.drop_cost
        self._error = np.zeros(count)
        self._start = np.zeros((count, 2))
        self._reached, self._dropped = np.zeros(count), np.zeros(count, dtype=bool)
        self._ends: dict[str, deque[float]] = {}
        super().__init__(
            description,
            distribution,
            turn_spec(description, distribution.digest(), task=task),
            count,
            ticks=task.ticks,
            start_noise=task.start_noise_rad,
            threads=threads,
            engine=engine,
        )

    @property
    def wanted(self) -> FloatArray:
        """The target orientations as rotation vectors around the identity, (N, 3) [rad]."""
        return self._builder.target

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw the targets of the restarted members: from their cubes' orientations about the vertical."""
        largest, position = self.task.largest_turn_rad, self.loop.position[where]
        turn = np.zeros((len(position), 3))
        turn[:, _UP] = rng.uniform(-largest, largest, len(turn))
        wanted = Rotation.from_rotvec(turn) * Rotation.from_rotvec(position[:, 3:6])
        self._builder.target[where] = wanted.as_rotvec()
        self._error[where] = self._angle(position, self.wanted[where])
        self._start[where] = position[:, :2]

    def outcomes(self) -> dict[str, FloatArray]:
        """Return each member's angle from its target [rad], and whether it is aligned, (N,) each."""
        aligned = (self._reached < self.task.tolerance_rad) & ~self._dropped
        return {"rotation_error_rad": self._reached, "aligned": aligned.astype(float)}

    def step(
        self, actions: FloatArray
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Note how episodes end; the rest is as in every environment."""
        result = super().step(actions)
        over = result[2] | result[3]
        for name, values in self.outcomes().items():
            self._ends.setdefault(name, deque(maxlen=100)).extend(values[over].tolist())
        return result

    def measures(self) -> dict[str, float]:
        """Return means of the last hundred episodes: share of time up, and the outcomes at the ends."""
        ends = {name: float(np.nanmean(values)) for name, values in self._ends.items() if values}
        return {**super().measures(), **ends}

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        error = self._angle(position, self.wanted)
        reward = task.progress_weight * (self._error - error) + task.holding_reward
        reward += task.aligned_weight / (1.0 + error / task.tolerance_rad)
        reward -= task.shift_weight * np.square(position[:, :2] - self._start).sum(axis=1)
        reward -= task.control_weight * np.square(action).sum(axis=1)
        reward -= task.action_weight * np.square(action - before).sum(axis=1)
        self._error, self._reached = error, error.copy()
        self._dropped = self.ended(position, velocity)
        return np.asarray(reward)

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which cubes have fallen off."""
        return np.asarray(position[:, 2] < self.task.least_height_m)

    @staticmethod
    def _angle(position: FloatArray, wanted: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(rotation_between(position[:, 3:6], wanted), axis=1))
