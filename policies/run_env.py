"""The running task of a robot with torque motors, the ant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.locomotion import (
    GRAVITY,
    HEIGHT,
    LocomotionEnv,
    base,
    joint_terms,
    locomotion_spec,
    vector_terms,
)
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RunTask:
    """Settings of the task; the defaults are what the ant's shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        forward_weight: Reward of speed along the world's x axis [s/m].
        healthy_reward: Reward of a tick in which the robot is healthy.
        control_weight: Cost of the sum of squared actions.
        top_height_m: Torso height above which the episode ends, as in gymnasium.
        least_height_m: Torso height below which it ends.
        start_noise_rad: Largest deviation of joints at the start.
    """

    ticks: int = 250
    forward_weight: float = 1.0
    healthy_reward: float = 0.2
    control_weight: float = 0.1
    top_height_m: float = 1.0
    least_height_m: float = -math.inf
    start_noise_rad: float = 0.1

    def __post_init__(self) -> None:
        check_task(self, "top_height_m")


def run_spec(description: RobotDescription, trained_under: str) -> PolicySpec:
    """Return the layout of observation and action: the full state without the place, and the last action.

    Directions are in the torso's frame. Gymnasium's quaternion has two values, q and -q, for one orientation.
    """
    terms = [ObservationTerm("height", "z", 2.0), *vector_terms("gravity", 1.0)]
    terms += [*vector_terms("heading", 1.0), *vector_terms("linear_velocity", 0.5)]
    terms += [*vector_terms("angular_velocity", 0.2), *joint_terms(description, 0.1)]
    scale = (1.0,) * len(description.actuated)
    return locomotion_spec(description, terms, scale, trained_under)


class RunEnv(LocomotionEnv):
    """Run along the world's x axis.

    The reward of a tick, from the true state after it, is gymnasium's Ant (version 4)::

        forward_weight vx + healthy_reward - control_weight |a|²

    and 0 in the tick in which the robot stops being healthy, which ends the episode. A robot is healthy while
    its torso is not upside down and its height is within the task's. For the ant, two things differ from
    gymnasium. First, there is no least height of 0.2 m: the soft floors of this distribution let a resting
    ant sink lower. Second, two weights are smaller here: that of control (0.5), as the gear is 15 instead of
    150, and that of health (1), a constant that would occupy the critics of a short training.

    Args:
        description: The robot.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
    """

    failure_reward = 0.0

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: RunTask | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task or RunTask()
        super().__init__(
            description,
            distribution,
            run_spec(description, distribution.digest()),
            count,
            ticks=self.task.ticks,
            start_noise=self.task.start_noise_rad,
            threads=threads,
            engine=engine,
        )

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        forward = task.forward_weight * velocity[:, 0]
        return np.asarray(forward + task.healthy_reward - task.control_weight * np.square(action).sum(axis=1))

    def forward_speed(self) -> FloatArray:
        """Return the speeds along the world's x axis, (N,) [m/s]."""
        return self.loop.velocity[:, 0]

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which robots lie on the back, fell or flew off."""
        seen = base(position, velocity)
        height, task = seen[:, HEIGHT], self.task
        over = (height > task.top_height_m) | (height < task.least_height_m)
        return np.asarray((seen[:, GRAVITY][:, 2] > 0.0) | over)
