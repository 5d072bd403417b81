"""The walking task of the Go2: stand, or shuffle forward at a commanded speed, without falling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.locomotion import (
    ANGULAR,
    GRAVITY,
    HEIGHT,
    LINEAR,
    LocomotionEnv,
    base,
    joint_terms,
    locomotion_spec,
    vector_terms,
)
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.types import FloatArray

ACTION_SCALE_RAD: Final = {"hip": 0.4, "thigh": 0.7, "calf": 0.8}
"""Targets reach this far from the standing pose: as far as a weak drive needs, and within the ranges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WalkTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        speed_m_s: Lowest and highest commanded forward speed.
        standing: Share of the episodes in which the command is to stand.
        tracking_weight: Reward of following the command.
        tracking_width: Squared error of the velocity at which that reward falls to 1/e [m²/s²].
        alive_reward: Reward of a tick without a fall.
        tilt_weight: Cost of the squared horizontal part of gravity's direction.
        turn_weight: Cost of the squared yaw rate [s²/rad²].
        height_weight: Cost of the squared deviation from ``height_m`` [1/m²].
        height_m: Wanted height of the base.
        action_weight: Cost of the squared change of the action.
        fall_cost: Cost of falling.
        lowest_m: A lower base has fallen.
        largest_tilt: A cosine of the tilt below this has fallen.
        start_noise_rad: Largest deviation of joints at the start.
    """

    ticks: int = 250
    speed_m_s: tuple[float, float] = (0.1, 0.5)
    standing: float = 0.2
    tracking_weight: float = 1.5
    tracking_width: float = 0.08
    alive_reward: float = 0.5
    tilt_weight: float = 2.0
    turn_weight: float = 0.1
    height_weight: float = 10.0
    height_m: float = 0.26
    action_weight: float = 0.02
    fall_cost: float = 5.0
    lowest_m: float = 0.1
    largest_tilt: float = 0.5
    start_noise_rad: float = 0.05

    def __post_init__(self) -> None:
        check_task(self.ticks, tracking_width=self.tracking_width)
        if not 0 <= self.speed_m_s[0] <= self.speed_m_s[1]:
            raise ConfigurationError(
                f"speed_m_s must be (low, high) with 0 <= low <= high, got {self.speed_m_s}"
            )
        if not 0 <= self.standing <= 1:
            raise ConfigurationError(f"standing must lie in [0, 1], got {self.standing!r}")


def walk_spec(
    description: RobotDescription,
    trained_under: str = "",
    training: Mapping[str, Any] | None = None,
) -> PolicySpec:
    """Return the layout of observation and action: joints, gyro, gravity, command and the last action.

    Only what a real Go2 measures: no base velocity, no height.
    """
    terms = [*vector_terms("gravity", 1.0), *vector_terms("angular_velocity", 0.25)]
    terms += [ObservationTerm("command", "x", 2.0), *joint_terms(description, 0.05)]
    scale = [ACTION_SCALE_RAD[name.split("_")[1]] for name in description.actuated]
    return locomotion_spec(description, terms, scale, trained_under, training)


class Go2Env(LocomotionEnv):
    """Follow a forward speed that is drawn for each episode.

    The reward of a tick, from the true state after it, with velocities in the base's frame, is::

        tracking_weight exp(-((vx - command)² + vy²) / tracking_width) + alive_reward
        - tilt_weight (gx² + gy²) - turn_weight wz² - height_weight (z - height_m)²
        - action_weight |a - a_before|²

    and -fall_cost in the tick in which the base tilts or sinks too far, which ends the episode.

    Args:
        description: The robot.
        distribution: What each member's parameters and latency are drawn from.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
    """

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: WalkTask | None = None,
        threads: int | None = 1,
    ) -> None:
        self.task = task or WalkTask()
        self.failure_reward = -self.task.fall_cost
        super().__init__(
            description, distribution, walk_spec(description, distribution.digest()), count,
            ticks=self.task.ticks, start_noise=self.task.start_noise_rad, threads=threads,
        )  # fmt: skip

    @property
    def command(self) -> FloatArray:
        """The wanted velocity of each member's base: x, y [m/s] and yaw rate [rad/s], (N, 3)."""
        return self._builder.command

    def wanted_speed(self) -> FloatArray:
        """Return the commanded forward speeds, (N,) [m/s]."""
        return self.command[:, 0]

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw the commands of the members that start anew."""
        count = int(where.sum())
        speed = rng.uniform(*self.task.speed_m_s, count)
        self.command[where, 0] = np.where(rng.random(count) < self.task.standing, 0.0, speed)

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; the class says how it is made."""
        task, seen = self.task, base(position, velocity)
        error = np.square(seen[:, LINEAR][:, :2] - self.command[:, :2]).sum(axis=1)
        reward = task.tracking_weight * np.exp(-error / task.tracking_width) + task.alive_reward
        reward -= task.tilt_weight * np.square(seen[:, GRAVITY][:, :2]).sum(axis=1)
        reward -= task.turn_weight * np.square(seen[:, ANGULAR][:, 2])
        reward -= task.height_weight * np.square(seen[:, HEIGHT] - task.height_m)
        return np.asarray(reward - task.action_weight * np.square(action - before).sum(axis=1))

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return who fell."""
        seen = base(position, velocity)
        tilted = -seen[:, GRAVITY][:, 2] < self.task.largest_tilt
        return np.asarray(tilted | (seen[:, HEIGHT] < self.task.lowest_m))
