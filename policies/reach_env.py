"""The reaching task of an arm: bring its joints to a pose, where they really are."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.motions.behaviours import centre
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import ServoVectorEnv, check_task
from deal_hw.policy import ObservationTerm, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ReachTask:
    """Settings of the task; the defaults are what the SO-101's shipped policy was trained with.

    Attributes:
        ticks: Control periods in an episode.
        hold_ticks: Control periods for which a pose is to be reached.
        share: Poses are drawn in this share of each joint's range of targets, around its middle.
        precision_rad: Mean error at which the precise part of the reward falls to a third.
        precise_weight: Weight of that part.
        action_weight: Cost of the squared change of the action.
        target_step_rad: Largest change of a target in a control period, as the safety filter has it.
        host_delay_s: Lowest and highest delay of the host [s].
    """

    ticks: int = 240
    hold_ticks: int = 80
    share: float = 0.7
    precision_rad: float = 0.02
    precise_weight: float = 2.0
    action_weight: float = 1.0
    target_step_rad: float = 0.072
    host_delay_s: tuple[float, float] = (0.0, 0.012)

    def __post_init__(self) -> None:
        check_task(self, "hold_ticks", "share", "precision_rad", "target_step_rad")


def reach_spec(description: RobotDescription, trained_under: str = "") -> PolicySpec:
    """Return the layout of observation and action: joints, the pose to reach, two former actions.

    Action 1 or -1 is the end of a joint's range that is further from its default position. Two former actions
    show a member's delay; the last one lets the policy add up small corrections.
    """
    names = description.actuated
    terms = [ObservationTerm("position", name, 1.0) for name in names]
    terms += [ObservationTerm("velocity", name, 0.2) for name in names]
    terms += [ObservationTerm("joint_target", name, 1.0) for name in names]
    terms += [ObservationTerm("action", name, 1.0, delay) for delay in (1, 2) for name in names]
    ends = np.array(description.limits.target)
    return PolicySpec.of_robot(
        description,
        terms,
        tuple(np.abs(ends - centre(description)[:, None]).max(axis=1)),
        target_range=description.limits.target,
        trained_under=trained_under,
    )


class ReachEnv(ServoVectorEnv):
    """Bring all joints to a pose that changes a few times in an episode; nothing ends it early.

    With the mean absolute error e of the joints' true positions, the reward of a tick is::

        precise_weight exp(-e / precision_rad) - e - action_weight mean (a - a_before)²

    The true position differs from the reported one by the encoder's bias, which only a calibration knows.
    Targets move at most as fast as the safety filter lets them.

    Args:
        description: The arm.
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
        task: ReachTask | None = None,
        sensor: SensorModel | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
    ) -> None:
        self.task = task or ReachTask()
        super().__init__(
            description,
            distribution,
            reach_spec(description, distribution.digest()),
            count,
            ticks=self.task.ticks,
            host_delay_s=self.task.host_delay_s,
            sensor=sensor,
            threads=threads,
            engine=engine,
        )
        self._ends = np.array(self.layout.target_range).T
        self._joints = list(description.actuated_index)
        self._sent = np.zeros((count, len(self._joints)))
        self._reached: deque[float] = deque(maxlen=200)

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw poses, at rest."""
        poses = np.tile(np.array(self.description.default_position), (count, 1))
        poses[:, self._joints] = self._drawn(rng, count)
        return poses, np.zeros_like(poses)

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw the first poses to reach of the restarted members."""
        self._sent[where] = self.loop.position[where][:, self._joints]
        self._aim(where, rng)

    def target(self, action: FloatArray) -> FloatArray:
        """Return the targets of actions, (N, A), within a step of those before."""
        step = self.task.target_step_rad
        wanted = np.clip(super().target(action), *self._ends)
        self._sent = np.clip(wanted, self._sent - step, self._sent + step)
        return self._sent

    def feedback(self) -> FloatArray:
        """Return the linear part of the policy, (A, O): the pose to reach is the target."""
        found = np.zeros((len(self._joints), len(self.layout.observation)))
        for k, term in enumerate(self.layout.observation):
            if term.quantity == "joint_target":
                a = self.layout.actuated.index(term.joint)
                found[a, k] = 1.0 / (self._scale[a] * term.scale)
        return found

    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick; see the class."""
        task = self.task
        error = np.abs(self._off(position)).mean(axis=1)
        reward = task.precise_weight * np.exp(-error / task.precision_rad) - error
        reward -= task.action_weight * np.square(action - before).mean(axis=1)
        again = (self._elapsed + 1) % task.hold_ticks == 0
        if again.any():
            self._reached.extend(error[again].tolist())
            self._aim(again, self.np_random)
        return np.asarray(reward)

    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return that no member failed, (N,)."""
        return np.zeros(self.num_envs, dtype=bool)

    def measures(self) -> dict[str, float]:
        """Return the joints' mean absolute error at the ends of the last two hundred holds [rad]."""
        return {"joint_error_rad": float(np.mean(self._reached))} if self._reached else {}

    def _off(self, position: FloatArray) -> FloatArray:
        """Return how far the joints really are from the pose to reach, (N, A) [rad]."""
        true = self.loop.batch.true_joints(position)
        return np.asarray((true - self._builder.joint_target)[:, self._joints])

    def _aim(self, where: BoolArray, rng: np.random.Generator) -> None:
        goals = self._builder.joint_target[where]
        goals[:, self._joints] = self._drawn(rng, int(where.sum()))
        self._builder.joint_target[where] = goals

    def _drawn(self, rng: np.random.Generator, count: int) -> FloatArray:
        low, high = np.array(self.description.limits.target).T
        reach = 0.5 * self.task.share * (high - low)
        return np.asarray(0.5 * (low + high) + rng.uniform(-1.0, 1.0, (count, len(low))) * reach)
