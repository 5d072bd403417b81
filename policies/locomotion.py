"""Common part of tasks of robots with a floating base: starts, termination by tilt, specs, scoring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.demonstration import BatchPolicy, limited_action
from deal_hw.policies.servo_loop import BoolArray
from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.policy import AXES, ObservationTerm, PolicySpec, Quantity, base_features
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.gpu import EngineName
from deal_hw.types import FloatArray

POOL = 64
"""Number of settled robots from which episodes start."""

GRAVITY, HEADING, ANGULAR, LINEAR, HEIGHT = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
"""Columns of :func:`deal_hw.policy.base_features`."""


class LocomotionEnv(ServoVectorEnv):
    """Robots on a floor that start from rest in their default pose.

    A start is drawn from a pool of robots of the same distribution that stood (or lay) for ``settle_s``, like
    a target before its recording. Robots that fell while settling are left out.

    Attributes:
        settle_s: Settling time of the pool [s].

    Args:
        description: The robot; its base floats.
        distribution: Distribution of each member's parameters and latency.
        layout: Layout of observation and action.
        count: Members N.
        ticks: Control periods in an episode.
        start_noise: Largest deviation of a joint from its settled position [rad].
        host_delay_s: Lowest and highest delay of the host, added to the distribution's latency [s].
        threads: Threads of the physics; None for all CPUs.
        engine: What simulates the physics.
        step_s: Physics step [s]; the device period by default.

    Raises:
        ConfigurationError: The robot's base is fixed, or no robot of the pool stays up.
    """

    settle_s: ClassVar[float] = 1.0

    def __init__(
        self,
        description: RobotDescription,
        distribution: ParameterDistribution,
        layout: PolicySpec,
        count: int,
        *,
        ticks: int,
        start_noise: float,
        host_delay_s: tuple[float, float] = (0.0, 0.0),
        threads: int | None = 1,
        engine: EngineName = "mujoco",
        step_s: float | None = None,
    ) -> None:
        if description.floating_base is None:
            raise ConfigurationError(
                f"robot {description.name!r} has a fixed base; locomotion needs a free one"
            )
        super().__init__(
            description,
            distribution,
            layout,
            count,
            ticks=ticks,
            host_delay_s=host_delay_s,
            threads=threads,
            engine=engine,
            step_s=step_s,
        )
        self._start_noise = start_noise
        self._pool = self._settled(threads)

    def start_setpoint(self) -> FloatArray:
        """Return the command that holds the default pose; zero for motors."""
        return self._default

    def start_state(self, rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Draw settled robots at rest, with small changes of their joints."""
        position = self._pool[rng.integers(len(self._pool), size=count)]
        joints = self.loop.batch.robot.joints
        position[:, joints] += rng.uniform(-1.0, 1.0, position[:, joints].shape) * self._start_noise
        return position, np.zeros_like(position)

    def limited(self, action: FloatArray, before: FloatArray) -> FloatArray:
        """Return the actions after the safety limit on the targets' steps."""
        return limited_action(self.description, self._scale, action, before)

    def forward_speed(self) -> FloatArray:
        """Return each member's forward speed, (N,) [m/s]; by default along its base's x axis."""
        return np.asarray(base(self.loop.position, self.loop.velocity)[:, LINEAR][:, 0])

    def wanted_speed(self) -> FloatArray | None:
        """Return each member's commanded speed, (N,) [m/s]; None where faster is better."""
        return None

    def outcomes(self) -> Mapping[str, FloatArray]:
        """Return what a task reached in the last tick, (N,) each, also of members that it ended; by name."""
        return {}

    def _settled(self, threads: int | None) -> FloatArray:
        # Fixed draws: the pool is part of the task and does not depend on the seed of a reset.
        space, robot = self.distribution.space, self.loop.batch.robot
        batch = ServoBatch(robot, space, POOL, threads)
        batch.set_parameters(self.distribution.sample(np.random.default_rng(0), POOL))
        start = batch.position
        start[:, robot.joints] = self.description.default_position
        batch.set_state(start, np.zeros_like(start))
        position, velocity = start, np.zeros_like(start)
        if steps := round(self.settle_s / robot.step_s):
            moved = batch.advance(np.broadcast_to(self._default, (POOL, steps, len(self._default))))
            position, velocity = moved[0][:, 0], moved[1][:, 0]
        fit: BoolArray = np.asarray(np.isfinite(position).all(axis=1))
        fit[fit] = ~self.ended(position[fit], velocity[fit])
        if not fit.any():
            raise ConfigurationError(
                f"none of {POOL} robots {self.description.name!r} can hold the default pose under the "
                "distribution; narrow it or correct the default pose"
            )
        return np.asarray(position[fit])


def base(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the features of the bases of states, (N, C) each: (N, 13)."""
    return base_features(position[:, :6], velocity[:, :6])


def vector_terms(quantity: Quantity, scale: float) -> list[ObservationTerm]:
    """Return the terms of a quantity's three axes."""
    return [ObservationTerm(quantity, axis, scale) for axis in AXES]


def joint_terms(description: RobotDescription, velocity_scale: float) -> list[ObservationTerm]:
    """Return the terms of joint positions, joint velocities and the last action."""
    terms = [ObservationTerm("position", name, 1.0) for name in description.joint_names]
    terms += [ObservationTerm("velocity", name, velocity_scale) for name in description.joint_names]
    return terms + [ObservationTerm("action", name, 1.0, 1) for name in description.actuated]


def locomotion_spec(
    description: RobotDescription,
    terms: Sequence[ObservationTerm],
    action_scale: Sequence[float],
    trained_under: str,
    **more: Any,
) -> PolicySpec:
    """Return a spec with the description's gains and with its limits inside the safety limits.

    ``more`` are further fields of the spec.
    """
    effort = tuple(map(min, description.effort_limit, description.limits.effort))
    return PolicySpec.of_robot(
        description, terms, action_scale, effort_limit=effort, trained_under=trained_under, **more
    )


def judge(policy: BatchPolicy, env: LocomotionEnv, seed: int) -> dict[str, Any]:
    """Evaluate a policy in one episode of each member of an environment.

    Args:
        policy: The policy.
        env: The environment; each member is another draw of its distribution.
        seed: Seeds the draws.

    Returns:
        Plain JSON values: undiscounted returns, share of fallen robots, share of time up, and the task's
        measures. For robots that did not fall: mean forward speed [m/s], and the mean distance of each
        robot's mean speed from its mean commanded one. ``outcomes`` are means of what the task reached at
        the episodes' ends.
    """
    env.observe_for(policy.spec)
    observation, _ = env.reset(seed=seed)
    count = env.num_envs
    going, total, lasted, way = np.ones(count, dtype=bool), np.zeros(count), np.zeros(count), np.zeros(count)
    fell: BoolArray = np.zeros(count, dtype=bool)
    wish: FloatArray | None = None if env.wanted_speed() is None else np.zeros(count)
    ends: dict[str, FloatArray] = {}
    env.measures()
    for _ in range(env.ticks):
        speed, wanted = env.forward_speed(), env.wanted_speed()
        if wish is not None and wanted is not None:
            wish += np.where(going, wanted, 0.0)
        observation, reward, terminated, truncated, _ = env.step(policy.act_batch(observation))
        total += np.where(going, reward, 0.0)
        way += np.where(going, speed, 0.0)
        lasted += going
        fell |= going & terminated
        over = going & (terminated | truncated)
        for name, values in env.outcomes().items():
            ends.setdefault(name, np.full(count, np.nan))[over] = values[over]
        going &= ~over
    up, mean = ~fell, way / lasted
    error = None if wish is None else np.abs(mean - wish / lasted)
    return {
        "robots": count,
        "seed": seed,
        "episode_s": env.ticks / env.description.control_rate_hz,
        "return_mean": float(total.mean()),
        "return_std": float(total.std()),
        "return_quartiles": [float(x) for x in np.quantile(total, (0.25, 0.5, 0.75))],
        "fall_rate": float(fell.mean()),
        "time_up": float((lasted / env.ticks).mean()),
        "forward_speed_m_s": float(mean[up].mean()) if up.any() else None,
        "speed_error_m_s": float(error[up].mean()) if up.any() and error is not None else None,
        "measures": env.measures(),
        "outcomes": {name: float(np.nanmean(values)) for name, values in ends.items()},
    }
