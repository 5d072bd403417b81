"""A hidden target of the transfer bench: the episodes that judge a policy, and a walking robot's speeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from deal_hw.bench.rows import Row
from deal_hw.bench.tasks import TASKS, Case
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.demonstration import BatchPolicy
from deal_hw.robots import training_task
from deal_hw.sim.engine.model import load_model
from deal_hw.types import FloatArray
from deal_hw.workflows.robot import described

EPISODES: Final = 32
JUDGED: Final = 1_000_000
"""Distance between a training's seed and that of the episodes that judge it."""

WORKS: Final = 0.9
"""A policy works in a target if its episodes last this share of their time on average."""

STEP_S: Final = 2.5
"""Time of each command of the Go2's speed profile [s]."""
AHEAD_M_S: Final = (0.25, 0.5, 0.75, 1.0)
ASIDE_M_S: Final = (0.125, 0.25, 0.375, 0.5)
"""Commanded speeds of the profile: ahead, then to the left. The last ones are the ends of the training."""
SAMPLES: Final = 5
"""Stored samples of each command."""
ALL_TIME: Final = 10**9


def truth_of(case: Case) -> ParameterDistribution:
    """Return the target's true parameters and latency, without uncertainty."""
    return ParameterDistribution.point(case.space, case.theta, case.latency_s)


def target_env(task: str, truth: ParameterDistribution, count: int, ticks: int | None = None) -> Any:
    """Return N copies of a target as an environment.

    The Go2's is not pushed and carries nothing, its encoders have no bias, and the friction of its floor is
    the model's. Its training draws all these, for every method alike.

    Args:
        task: Name of the task.
        truth: The target's parameters.
        count: N.
        ticks: Control periods of a speed profile; None for the task's own episodes and commands.
    """
    more: dict[str, Any] = {}
    if TASKS[task].walks:
        from deal_hw.policies.go2_env import WalkTask

        friction = float(load_model(described(task)).model.geom("floor").friction[0])
        quiet: dict[str, Any] = {
            "push_m_s": 0.0,
            "payload_kg": (0.0, 0.0),
            "encoder_bias_rad": 0.0,
            "friction": (friction, friction),
        }
        if ticks is not None:
            quiet |= {"ticks": ticks, "command_ticks": ALL_TIME}
        more["task"] = WalkTask(**quiet)
    return training_task(task).make(described(task), truth, count, **more)


def judged(task: str, truth: ParameterDistribution, policy: BatchPolicy, seed: int) -> Row:
    """Return the returns of a policy's episodes in a target: mean and worst, and how long they lasted."""
    env = target_env(task, truth, EPISODES)
    env.observe_for(policy.spec)
    observation, _ = env.reset(seed=seed + JUDGED)
    going, total, lasted = np.ones(EPISODES, dtype=bool), np.zeros(EPISODES), np.zeros(EPISODES)
    upright = TASKS[task].upright
    for _ in range(env.ticks):
        observation, reward, terminated, truncated, _ = env.step(policy.act_batch(observation))
        if upright is not None:
            reward = np.where(terminated, 0.0, reward + upright)
        total += np.where(going, reward, 0.0)
        lasted += going
        going &= ~(terminated | truncated)
    return {
        "return": float(total.mean()),
        "return_worst": float(total.min()),
        "time_up": float((lasted / env.ticks).mean()),
    }


def commands(ahead_m_s: Sequence[float] = AHEAD_M_S, aside_m_s: Sequence[float] = ASIDE_M_S) -> FloatArray:
    """Return the commands of the speed profile, (P, 3): x, y [m/s], yaw rate [rad/s]."""
    ahead = [(speed, 0.0, 0.0) for speed in ahead_m_s]
    return np.array([*ahead, *((0.0, speed, 0.0) for speed in aside_m_s)])


def speed_profile(
    task: str,
    truth: ParameterDistribution,
    policy: BatchPolicy,
    seed: int,
    count: int = 8,
    profile: FloatArray | None = None,
) -> Row:
    """Let N robots follow increasing speeds, as in the right half of DEAL's Figure 4.

    A robot that has fallen has speed 0 from then on. The profile, (P, 3), is :func:`commands` by default: one
    half ahead, one half aside.

    Returns:
        Under ``speed``: times [s], commanded and mean speeds in x and y [m/s]; beside it the mean errors of
        the speeds and the number of falls.
    """
    rate_hz = described(task).control_rate_hz
    asked_for = commands() if profile is None else profile
    wanted = np.repeat(asked_for, round(STEP_S * rate_hz), axis=0)
    # One tick more: the environment restarts a robot in the tick in which its time is over.
    env = target_env(task, truth, count, ticks=len(wanted) + 1)
    env.observe_for(policy.spec)
    observation, _ = env.reset(seed=seed + JUDGED)
    going = np.ones(count, dtype=bool)
    speeds = np.zeros((len(wanted), count, 2))
    for tick, command in enumerate(wanted):
        env.command[:] = command
        observation, _, terminated, _, _ = env.step(policy.act_batch(observation))
        going &= ~terminated
        speeds[tick, going] = base_speed(env)[going]
    found, asked = speeds.mean(axis=1), wanted[:, :2]
    every = len(wanted) // (len(asked_for) * SAMPLES)
    parts = found.reshape(-1, every, 2).mean(axis=1)
    ahead, aside = np.split(np.abs(found - asked), [len(wanted) // 2])
    return {
        "speed": {
            "time_s": [round((i + 0.5) * every / rate_hz, 3) for i in range(len(parts))],
            "wanted_x_m_s": asked[::every, 0].tolist(),
            "wanted_y_m_s": asked[::every, 1].tolist(),
            "x_m_s": np.round(parts[:, 0], 4).tolist(),
            "y_m_s": np.round(parts[:, 1], 4).tolist(),
        },
        "speed_error_x_m_s": float(ahead[:, 0].mean()),
        "speed_error_y_m_s": float(aside[:, 1].mean()),
        "falls": int((~going).sum()),
    }


def base_speed(env: Any) -> FloatArray:
    """Return the true velocities of the bases in their own frames, (N, 2): ahead, to the left [m/s]."""
    from deal_hw.policies.locomotion import LINEAR, base

    return np.asarray(base(env.loop.position, env.loop.velocity)[:, LINEAR][:, :2])
