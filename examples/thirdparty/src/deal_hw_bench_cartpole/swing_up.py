"""The training task: swing the pole up from hanging, catch it, and keep it upright within the track."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.motions.scores.balance import CART, POLE
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.tasks import TrainingTask
from deal_hw.policies.vector_env import ServoVectorEnv, check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray

VELOCITIES: Final = 3
ACTIONS: Final = 3
"""Numbers of velocities and past actions that the policy observes."""
UPRIGHT_RAD: Final = 0.3
"""A pole within this angle counts as upright, for the progress of a training [rad]."""
STEP_S: Final = 0.002
"""Physics step: a tenth of the control period [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SwingUpTask:
    """Settings of the task.

    Attributes:
        ticks: Control periods in an episode.
        hanging_share: Share of the episodes that begin with a pole that hangs nearly at rest. The others
            begin at any angle, so that catching is learned before swinging up succeeds.
        start_position_m: Largest cart position at the start.
        start_turn_rad_s: Largest speed of the pole at the start of the other episodes.
        end_position_m: A larger cart position ends the episode, before the driver's limit of 0.19 m does.
        middle_m: Distance from the middle of the track at which the reward has fallen to 1/e.
        still_rad_s: Speed of an upright pole at which its reward has fallen to 1/e.
        action_weight: Cost of the squared change of the action from tick to tick.
        fall_cost: Cost of leaving the track.
        host_delay_s: Lowest and highest delay of the host, added to the robot's own latency [s].
    """

    ticks: int = 400
    hanging_share: float = 0.5
    start_position_m: float = 0.08
    start_turn_rad_s: float = 8.0
    end_position_m: float = 0.18
    middle_m: float = 0.12
    still_rad_s: float = 2.0
    action_weight: float = 0.02
    fall_cost: float = 20.0
    host_delay_s: tuple[float, float] = (0.0, 0.006)

    def __post_init__(self) -> None:
        check_task(self, "end_position_m", "middle_m", "still_rad_s")
        if not 0 <= self.hanging_share <= 1:
            raise ConfigurationError(f"hanging_share must be 0 to 1, got {self.hanging_share}")


def swing_up_spec(description: RobotDescription, trained_under: str = "") -> PolicySpec:
    """Return the layout of observation and action: the action is the share of the motor's voltage.

    The pole's angle is observed by sine and cosine, so full turns make no difference. A command acts one
    control period later, so the policy observes its last commands.
    """
    cart, pole = description.joint_names
    terms = [
        ObservationTerm("position", cart, 8.0),
        ObservationTerm("sin_position", pole, 1.0),
        ObservationTerm("cos_position", pole, 1.0),
    ]
    for delay in range(VELOCITIES):
        terms += [
            ObservationTerm("velocity", cart, 2.0, delay),
            ObservationTerm("velocity", pole, 0.15, delay),
        ]
    terms += [ObservationTerm("action", cart, 1.0, delay) for delay in range(1, ACTIONS + 1)]
    return PolicySpec.of_robot(description, terms, (1.0,), trained_under=trained_under)


class SwingUpEnv(ServoVectorEnv):
    """Swing the pole up with the motor, catch it, and keep it upright near the middle of the track.

    The reward of a tick, from the true state after it, is::

        height² (1 + still) / 2 (1 + middle) / 2 - action_weight (a - a_before)²
        height = (1 + cos angle) / 2, still = exp(-(speed / still_rad_s)²), middle = exp(-(cart / middle_m)²)

    and -fall_cost in the tick in which the cart leaves the middle of the track, which ends the episode.

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
        task: SwingUpTask | None = None,
        sensor: SensorModel | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task or SwingUpTask()
        self.failure_reward = -self.task.fall_cost
        super().__init__(
            description,
            distribution,
            swing_up_spec(description, distribution.digest()),
            count,
            ticks=self.task.ticks,
            host_delay_s=self.task.host_delay_s,
            sensor=sensor,
            threads=threads,
            engine=engine,
            step_s=STEP_S,
        )
        self._upright = np.zeros(0)

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw hanging poles, and poles at any angle that turn."""
        task = self.task
        position, velocity = np.zeros((2, count, 2))
        hangs = rng.uniform(size=count) < task.hanging_share
        position[:, CART] = rng.uniform(-1.0, 1.0, count) * task.start_position_m
        turn = np.where(hangs, 1.0 + 0.05 * rng.normal(size=count), rng.uniform(-1.0, 1.0, count))
        position[:, POLE] = np.pi * turn
        velocity[:, POLE] = task.start_turn_rad_s * np.where(hangs, 0.05, rng.uniform(-1.0, 1.0, count))
        return position, velocity

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        height = 0.5 * (1.0 + np.cos(position[:, POLE]))
        still = np.exp(-np.square(velocity[:, POLE] / task.still_rad_s))
        middle = np.exp(-np.square(position[:, CART] / task.middle_m))
        reward = height**2 * 0.5 * (1.0 + still) * 0.5 * (1.0 + middle)
        self._upright = np.cos(position[:, POLE]) > np.cos(UPRIGHT_RAD)
        return np.asarray(reward - task.action_weight * np.square(action - before).sum(axis=1))

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which members left the track."""
        return np.asarray(np.abs(position[:, CART]) > self.task.end_position_m)

    def measures(self) -> dict[str, float]:
        """Return the share of members whose pole is upright now, beside how long episodes last."""
        upright = {"upright": float(self._upright.mean())} if self._upright.size else {}
        return {**upright, **super().measures()}


SWING_UP: Final = TrainingTask(
    environment="deal_hw_bench_cartpole.swing_up:SwingUpEnv",
    trainer="sac",
    members={"ppo": 128, "sac": 32},
    settings={
        "ppo": {"hidden": (64, 64), "reward_scale": 0.1, "steps": 5_000_000},
        "sac": {
            "steps": 250_000,
            "gamma": 0.98,
            "gradient_steps": 8,
            "batch": 256,
            "learning_rate": 1e-3,
            "target_entropy": -1.0,
            "warmup": 3_000,
            "averaged": 0.1,
        },
    },
    udr_ratio=2.0,
    udr_latency_s=(0.018, 0.03),
)
"""Both trainers are offered with plain settings: SAC's are those of deal-hw's cart-pole with more steps."""
