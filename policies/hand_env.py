"""The Allegro hand's task: turn a cube on the palm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.locomotion import LocomotionEnv, joint_terms, locomotion_spec, vector_terms
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.types import FloatArray

YAW_RATE = 5
"""Index among a floating base's velocities: rotation about the world's vertical while it does not tilt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TurnTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        turn_weight: Reward of turning [s/rad].
        fastest_rad_s: Rate above which turning earns no more: a thrown cube turns fastest.
        holding_reward: Reward of a tick with the cube on the hand.
        control_weight: Cost of the sum of squared actions.
        action_rad: Joint offset from the holding pose at action 1.
        least_height_m: Height below which the cube has fallen off.
        start_noise_rad: Largest deviation of joints at the start.
    """

    ticks: int = 250
    turn_weight: float = 1.0
    fastest_rad_s: float = 1.0
    holding_reward: float = 0.2
    control_weight: float = 0.01
    action_rad: float = 0.5
    least_height_m: float = 0.02
    start_noise_rad: float = 0.05

    def __post_init__(self) -> None:
        check_task(self, "fastest_rad_s", "action_rad")


def turn_spec(
    description: RobotDescription, trained_under: str = "", task: TurnTask | None = None
) -> PolicySpec:
    """Return the layout of observation and action: joints, last action, and the cube without its place."""
    terms = [ObservationTerm("height", "z", 10.0), *vector_terms("gravity", 1.0)]
    terms += [*vector_terms("heading", 1.0), *vector_terms("angular_velocity", 0.2)]
    terms += joint_terms(description, 0.1)
    scale = ((task or TurnTask()).action_rad,) * len(description.actuated)
    return locomotion_spec(description, terms, scale, trained_under)


class HandEnv(LocomotionEnv):
    """Turn the cube to the left on the hand; an episode ends when it falls off.

    The reward of a tick, from the true state after it, is::

        turn_weight min(yaw rate, fastest) + holding_reward - control_weight |a|²

    The paper's task is to reach an orientation. Turning is a simpler part of it, with the same motion of
    fingers and cube.

    Args:
        description: The hand; the cube is its floating base.
        distribution: Distribution of each member's parameters and latency.
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
        task: TurnTask | None = None,
        threads: int | None = 1,
    ) -> None:
        self.task = task or TurnTask()
        super().__init__(
            description,
            distribution,
            turn_spec(description, distribution.digest(), task=self.task),
            count,
            ticks=self.task.ticks,
            start_noise=self.task.start_noise_rad,
            threads=threads,
        )

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        turning = task.turn_weight * np.minimum(velocity[:, YAW_RATE], task.fastest_rad_s)
        return np.asarray(turning + task.holding_reward - task.control_weight * np.square(action).sum(axis=1))

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which cubes have fallen off."""
        return np.asarray(position[:, 2] < self.task.least_height_m)
