"""A vectorised Gymnasium environment of servo-driven robots with individual physics."""

from __future__ import annotations

import abc
import copy
import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from deal_hw.description import RobotDescription, SensorModel
from deal_hw.errors import ConfigurationError
from deal_hw.motions.behaviours import centre
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace
from deal_hw.policies.reference_motion import ReferenceMotion
from deal_hw.policies.servo_loop import BoolArray, ServoLoop
from deal_hw.policy import BASE_QUANTITIES, Observation, ObservationBuilder, PolicySpec
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.sim.engine.model import RobotModel
from deal_hw.types import FloatArray

FELT: Final = ("position", "velocity", "sin_position", "cos_position", "action", *BASE_QUANTITIES)
"""Quantities that tell of the robot itself: its joints, its actions and its base."""


NO_REFERENCE: Final = (
    "trainer amp imitates a reference motion, and this task has none: there is one of the Go2's canter; "
    "train it with ppo or sac"
)


def check_task(task: Any, *positive: str, not_negative: Sequence[str] = ()) -> None:
    """Check a task's settings: at least one tick, and those that must be positive or not negative, by name.

    Raises:
        ConfigurationError: One is not.
    """
    if task.ticks < 1:
        raise ConfigurationError(f"ticks must be at least 1, got {task.ticks}")
    for name in positive:
        if not getattr(task, name) > 0:
            raise ConfigurationError(f"{name} must be positive, got {getattr(task, name)!r}")
    for name in not_negative:
        if not getattr(task, name) >= 0:
            raise ConfigurationError(f"{name} must not be negative, got {getattr(task, name)!r}")


@dataclass(frozen=True, slots=True)
class Mirror:
    """A reflection of a vector: its entry k is ``sign[k]`` times the entry ``source[k]`` of the original.

    Attributes:
        source: Indices, (n,).
        sign: 1 or -1, (n,).
    """

    source: tuple[int, ...]
    sign: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Extrinsics:
    """What a simulator knows of its robots and a robot does not measure.

    Attributes:
        names: Names, (E,).
        size: Usual deviation of each, above 0, (E,).
        values: Deviations of each member from the model's nominal value, (N, E): of parameters with a log
            scale the logarithm of the ratio, of others the difference in their unit.
    """

    names: tuple[str, ...]
    size: FloatArray
    values: FloatArray

    def and_more(self, names: Sequence[str], size: float, values: FloatArray) -> Extrinsics:
        """Return these, followed by M others with one usual deviation, whose values are (N, M)."""
        sizes = np.concatenate([self.size, np.full(len(names), size)])
        return Extrinsics((*self.names, *names), sizes, np.hstack([self.values, values]))


class TaskKnowledge:
    """What trainers may use of a task beside its transitions; nothing by default.

    Attributes:
        layout: Layout of observation and action.
        engine: What simulates the physics.
    """

    layout: PolicySpec
    engine: EngineName = "mujoco"

    def feedback(self) -> FloatArray:
        """Return a fixed linear part of the policy, (A, O), that PPO adds to its network; zero by default."""
        return np.zeros((len(self.layout.actuated), len(self.layout.observation)))

    def reached(self) -> dict[str, Any]:
        """Return what training reached, plain JSON values for the policy's record; nothing by default."""
        return {}

    def progress(self) -> dict[str, Any]:
        """Return what a training that goes on from here must know of the task, plain JSON values.

        Such as how hard it has become. Nothing by default.
        """
        return {}

    def go_on(self, progress: Mapping[str, Any]) -> None:
        """Take over the :meth:`progress` of a former training of this task; nothing by default."""

    def mirror(self) -> tuple[Mirror, Mirror] | None:
        """Return the reflections of observation and action of a robot that is symmetric; None by default.

        PPO learns from each transition and from its reflection.
        """
        return None

    def extrinsics(self) -> Extrinsics | None:
        """Return what the simulator knows of its members now; None where nothing is known by name."""
        return None

    def motion(self) -> FloatArray:
        """Return what the bodies of the members do now, (N, F): the features of :meth:`imitate`.

        Raises:
            ConfigurationError: The task has no reference motion.
        """
        raise ConfigurationError(NO_REFERENCE)

    def imitate(self) -> ReferenceMotion:
        """Leave how to move to a reference motion: drop the rewards of a gait, and return the motion.

        Raises:
            ConfigurationError: The task has no reference motion.
        """
        raise ConfigurationError(NO_REFERENCE)

    def observe_history(self, periods: int) -> None:
        """Extend the observation by what was felt and done in so many former control periods.

        Raises:
            ConfigurationError: The task has an observation of its own, whose past is not known.
        """
        raise ConfigurationError(
            f"the observation of this task cannot be extended by {periods} former control periods; train it "
            "with ppo or sac"
        )


class ServoVectorEnv(TaskKnowledge, VectorEnv[Observation, FloatArray, Any], abc.ABC):
    """N robots that follow a policy's commands; a task defines starts and rewards.

    Members that end are restarted in the same step (Gymnasium's SAME_STEP); their last observation is in
    ``info["final_obs"]``. Observations come from the class that the robot uses, so the two always agree.

    Args:
        description: The robot.
        distribution: Distribution of each member's parameters and latency, drawn at the start of an episode.
        layout: Layout of observation and action.
        count: Members N.
        ticks: Control periods after which an episode is truncated.
        host_delay_s: Lowest and highest delay of the host, added to the distribution's latency [s]: the age
            of the newest state sample when the policy reads it, and the time on the wire.
        sensor: The sensor model; the description's by default.
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
        step_s: Physics step [s]; the device period by default.

    Attributes:
        layout: Layout of observation and action.
        own_terms: Number of terms of the task's own observation; they come first.
        failure_reward: The reward of the tick in which a member fails.
    """

    failure_reward: float = 0.0

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        layout: PolicySpec,
        count: int,
        *,
        ticks: int,
        host_delay_s: tuple[float, float],
        sensor: SensorModel | None = None,
        threads: int | None = 1,
        engine: EngineName = "mujoco",
        step_s: float | None = None,
    ) -> None:
        self.description, self.distribution = description, distribution
        self.num_envs = count
        self._observe_as(layout)
        self.own_terms = len(layout.observation)
        self.ticks = ticks
        self.engine = engine
        self.host_delay_s = host_delay_s
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(layout.actuated),), np.float32)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, count)
        # Calibrated parameters come first: the task draws only those that the distribution does not have.
        given = {(p.kind, name) for p in distribution.space.parameters for name in p.elements}
        self._extra = ParameterSpace(
            p for p in self.surroundings() if not given & {(p.kind, name) for name in p.elements}
        )
        self._space = ParameterSpace([*distribution.space.parameters, *self._extra.parameters])
        self._latency_s = np.zeros(count)
        self.loop = ServoLoop(
            description,
            self._space,
            count,
            sensor=sensor,
            threads=threads,
            engine=engine,
            step_s=step_s,
            scene=self.scene,
        )
        self._elapsed = np.zeros(count, dtype=np.int64)
        self._recent_shares: deque[float] = deque(maxlen=100)
        self._scale = np.array(layout.action_scale)
        self._default = centre(description)

    @abc.abstractmethod
    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw positions and velocities at the start of M episodes, (M, C) each."""

    def scene(self, robot: RobotModel) -> RobotModel:
        """Return the model to simulate, made from the robot's own; by default that one."""
        return robot

    def start_setpoint(self) -> FloatArray | None:
        """Return the first set-point and targets of episodes, (A,); None for each member's position."""
        return None

    def begin_episodes(self, where: BoolArray, rng: np.random.Generator) -> None:
        """Draw further values of a task for the restarted members, (N,); nothing by default."""

    def surroundings(self) -> Sequence[Parameter]:
        """Return parameters that the task draws uniformly for each episode; none by default."""
        return ()

    def measures(self) -> dict[str, float]:
        """Return the task's values since the last call, by name with its unit.

        By default the share of an episode's longest duration that members lasted, mean of the last hundred
        episodes; nothing before the first ends.
        """
        return {"time_up": float(np.mean(self._recent_shares))} if self._recent_shares else {}

    def privileged(self) -> FloatArray:
        """Return the critic's information beyond the observation, (N, P); nothing by default."""
        return np.zeros((self.num_envs, 0))

    def extrinsics(self) -> Extrinsics:
        """Return the drawn parameters and the total latency; E is 1 more than the free parameters."""
        space = self._space
        drawn = space.to_scale(self.loop.theta) - space.to_scale(space.nominal)
        known = Extrinsics(space.names, np.where(space.log_scale, 1.0, 0.5 * space.width), drawn)
        return known.and_more(["latency"], 1.0 / self.description.control_rate_hz, self._latency_s[:, None])

    def observe_history(self, periods: int) -> None:
        """Extend the observation by what was felt and done in former control periods; restart before a step.

        The new terms come last, one quantity after the other: those of joints, of the action and of the base,
        but not what the operator or a clock says. Those of a former call are replaced.
        """
        own = self.layout.observation[: self.own_terms]
        former = [
            dataclasses.replace(term, delay=term.delay + back)
            for quantity in FELT
            for back in range(1, periods + 1)
            for term in own
            if term.quantity == quantity
        ]
        more = [term for term in dict.fromkeys(former) if term not in own]
        self._observe_as(dataclasses.replace(self.layout, observation=(*own, *more)))

    def observe_for(self, policy: PolicySpec) -> None:
        """Observe what a policy observes, which may be other terms than the task's; restart before a step."""
        self._observe_as(dataclasses.replace(self.layout, observation=policy.observation))

    def _observe_as(self, layout: PolicySpec) -> None:
        self.layout = layout
        self._builder = ObservationBuilder(layout, (self.num_envs,))
        size = (len(layout.observation),)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )

    def target(self, action: FloatArray) -> FloatArray:
        """Return the targets of actions, (N, A) each."""
        return self._default + self._scale * action

    def sensed(self) -> tuple[FloatArray, FloatArray]:
        """Return the positions and velocities of observations, (N, C) each."""
        return self.loop.reported_position, self.loop.reported_velocity

    def limited(self, action: FloatArray, before: FloatArray) -> FloatArray:
        """Return the actions, (N, A), limited after those before; unchanged by default."""
        return action

    @abc.abstractmethod
    def reward(
        self, position: FloatArray, velocity: FloatArray, action: FloatArray, before: FloatArray
    ) -> FloatArray:
        """Return the reward of one tick, (N,), from the true state after it.

        Args:
            position: (N, C).
            velocity: (N, C).
            action: The action of this tick, (N, A).
            before: The action of the tick before, (N, A); zero at the start.
        """

    @abc.abstractmethod
    def ended(self, position: FloatArray, velocity: FloatArray) -> BoolArray:
        """Return which members failed, (N,)."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Restart all members; a seed fixes everything that follows."""
        super().reset(seed=seed, options=options)
        self._last_action = np.zeros((self.num_envs, len(self.layout.actuated)))
        self._restart(np.ones(self.num_envs, dtype=bool))
        return self._observe(), {}

    def step(
        self, actions: FloatArray
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Apply actions, (N, A), for one control period.

        Returns:
            Observations (N, O), rewards (N,), terminated (N,), truncated (N,), and infos: ``final_obs``
            (N, O) with the last observations of the members in ``_final_obs`` (N,).
        """
        action = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)
        action = self.limited(action, self._last_action)
        self._builder.record_action(action)
        diverged = self.loop.step(self.target(action), self.np_random)
        position, velocity = self.loop.position, self.loop.velocity
        terminated = self.ended(position, velocity) | diverged
        reward = np.where(
            terminated, self.failure_reward, self.reward(position, velocity, action, self._last_action)
        )
        self._last_action = action
        self._elapsed += 1
        truncated = (self._elapsed >= self.ticks) & ~terminated
        over = terminated | truncated
        if not over.any():
            return self._observe(), reward, terminated, truncated, {}
        self._recent_shares.extend((self._elapsed[over] / self.ticks).tolist())
        # Members that go on must observe this tick only once, so the final observation is built on a copy.
        final = copy.deepcopy(self._builder).build(*self.sensed())
        self._restart(over)
        return self._observe(), reward, terminated, truncated, {"final_obs": final, "_final_obs": over}

    def _restart(self, where: BoolArray) -> None:
        rng, count = self.np_random, int(where.sum())
        latency = self.distribution.sample_latency(rng, count) + rng.uniform(*self.host_delay_s, count)
        theta = np.hstack([self.distribution.sample(rng, count), self._extra.sample(rng, count)])
        position, velocity = self.start_state(rng, count)
        start = self.start_setpoint()
        setpoint = None if start is None else np.repeat(start[None], count, axis=0)
        self._latency_s[where] = latency
        self.loop.restart(where, theta, latency, position, velocity, rng, setpoint)
        self._builder.reset(where)
        self.begin_episodes(where, rng)
        self._elapsed[where] = 0
        self._last_action[where] = 0.0

    def _observe(self) -> Observation:
        return self._builder.build(*self.sensed())
