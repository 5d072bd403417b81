"""The balancing task of the cart-pole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.motions.scores.balance import CART, POLE
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import ServoVectorEnv, check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray

VELOCITIES, ACTIONS = 8, 14
"""Numbers of velocities and past actions that the policy observes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BalanceTask:
    """Settings of the task; the defaults are what the shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        start_angle_rad: Largest pole angle at the start.
        start_position_m: Largest cart position at the start.
        end_angle_rad: A larger pole angle ends the episode.
        end_position_m: A larger cart position ends the episode.
        action_scale_m: Cart target at action 1.
        angle_weight: Cost of the pole angle [1/rad].
        speed_weight: Cost of the cart speed [s/m].
        position_weight: Cost of the squared cart position [1/m²].
        action_weight: Cost of the change of the action from tick to tick.
        fall_cost: Cost of falling or leaving the range, in ticks of the worst possible angle.
        host_delay_s: Lowest and highest delay of the host, added to the robot's own latency [s]. The newest
            of 200 state samples per second is 0 to 5 ms old when the policy reads it; wire and computation
            take up to 2 ms.
    """

    ticks: int = 250
    start_angle_rad: float = 0.05
    start_position_m: float = 0.03
    end_angle_rad: float = 0.5
    end_position_m: float = 0.35
    action_scale_m: float = 0.25
    angle_weight: float = 5.0
    speed_weight: float = 0.1
    position_weight: float = 4.0
    action_weight: float = 0.0
    fall_cost: float = 25.0
    host_delay_s: tuple[float, float] = (0.0, 0.007)

    def __post_init__(self) -> None:
        check_task(self, "end_angle_rad", "end_position_m", "action_scale_m")
        low, high = self.host_delay_s
        if not 0 <= low <= high:
            raise ConfigurationError(
                f"host_delay_s must be (low, high) with 0 <= low <= high, got {self.host_delay_s}"
            )


def balance_spec(description: RobotDescription, task: BalanceTask, trained_under: str = "") -> PolicySpec:
    """Return the layout of observation and action.

    Positions now, velocities over 160 ms, actions over 280 ms. Velocities are differences of noisy reports
    and need averaging. The device's set-point is not reported, moves at a limited speed and pulls a cart with
    friction: only past actions show where it is. With three of each, a robot with a slow set-point and strong
    friction was not learned at all; with these it was in 10 000 steps.
    """
    cart, pole = description.joint_names[CART], description.joint_names[POLE]
    terms = [ObservationTerm("position", cart, 5.0), ObservationTerm("sin_position", pole, 10.0)]
    for delay in range(VELOCITIES):
        terms += [
            ObservationTerm("velocity", cart, 2.0, delay),
            ObservationTerm("velocity", pole, 0.3, delay),
        ]
    terms += [ObservationTerm("action", cart, 1.0, delay) for delay in range(1, ACTIONS + 1)]
    return PolicySpec.of_robot(description, terms, (task.action_scale_m,), trained_under=trained_under)


class CartPoleEnv(ServoVectorEnv):
    """Keep the pole upright with a small angle and a slow cart, near the middle of the rail.

    The reward of a tick, from the true state after it, is::

        exp(-cost) - 1
        cost = angle_weight |angle| + speed_weight |cart speed| + position_weight cart²
               + action_weight (a - a_before)²

    and -fall_cost in the tick in which the pole has fallen or the cart has left its range, which ends the
    episode. It lies in (-1, 0], so near upright it is minus the weighted sum: among policies that stay up,
    the return falls with the mean |angle|, by which the paper's Table 2 judges. The best reward is zero
    instead of one, so critics need not first learn the value of staying up for ever. Ending costs more than
    any way of staying up within the discount's horizon, which has the effect of an alive bonus.

    Args:
        description: The robot.
        distribution: Distribution of each member's parameters and latency.
        count: Members N.
        task: The settings.
        sensor: The sensor model; the description's by default.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
    """

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        count: int,
        *,
        task: BalanceTask | None = None,
        sensor: SensorModel | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task or BalanceTask()
        self.failure_reward = -self.task.fall_cost
        super().__init__(
            description,
            distribution,
            balance_spec(description, self.task, distribution.digest()),
            count,
            ticks=self.task.ticks,
            host_delay_s=self.task.host_delay_s,
            sensor=sensor,
            threads=threads,
            engine=engine,
        )

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw starts near upright, at rest."""
        reach = np.array([self.task.start_position_m, self.task.start_angle_rad])
        return rng.uniform(-1.0, 1.0, (count, 2)) * reach, np.zeros((count, 2))

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        cost = task.angle_weight * np.abs(position[:, POLE]) + task.speed_weight * np.abs(velocity[:, CART])
        cost += task.position_weight * np.square(position[:, CART])
        cost += task.action_weight * np.square(action - before).sum(axis=1)
        return np.exp(-cost) - 1.0

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which members fell or left the range."""
        task = self.task
        fell = np.abs(position[:, POLE]) > task.end_angle_rad
        return np.asarray(fell | (np.abs(position[:, CART]) > task.end_position_m))
