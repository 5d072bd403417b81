"""The reaching task: true errors, changing poses, and what the safety filter allows."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.drivers.so101.description import DESCRIPTION, biased_space
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.reach_env import ReachEnv, ReachTask
from deal_hw.workflows.train import nominal_distribution


def _env(**task: float) -> ReachEnv:
    return ReachEnv(DESCRIPTION, nominal_distribution("so101"), 4, task=ReachTask(**task))  # type: ignore[arg-type]


def _follow(env: ReachEnv) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the action whose target is the pose to reach."""
    goals = env._builder.joint_target[:, env._joints]
    return np.asarray((goals - env._default) / env._scale)


def test_the_linear_part_sends_the_pose_itself_as_target() -> None:
    """Feedback times observation is the action of that target."""
    env = _env()
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation @ env.feedback().T, _follow(env), atol=1e-6)


def test_targets_move_as_the_safety_filter_lets_them() -> None:
    """At most 0.072 rad in a control period, from the pose in which the episode began."""
    env = _env()
    env.reset(seed=0)
    before = env._sent.copy()
    np.testing.assert_allclose(before, env.loop.position, atol=1e-9)
    env.step(np.ones((4, 6)))
    assert np.abs(env._sent - before).max() == pytest.approx(0.072)


def test_the_pose_changes_after_its_time_and_only_then() -> None:
    """Three holds in an episode; no member ends early."""
    env = _env(ticks=30, hold_ticks=10)
    env.reset(seed=0)
    poses = []
    for tick in range(30):
        poses.append(env._builder.joint_target.copy())
        _, _, terminated, truncated, _ = env.step(np.zeros((4, 6)))
        assert not terminated.any() and truncated.all() == (tick == 29)
    changes = [k for k in range(1, 30) if not np.array_equal(poses[k], poses[k - 1])]
    assert changes == [10, 20]


def test_the_reward_is_of_true_positions() -> None:
    """An encoder that is wrong by 0.1 rad: what it reports at the pose is 0.1 rad beside it."""
    space = biased_space()
    values = [
        0.1 if name.endswith("encoder_bias") else p.nominal
        for name, p in zip(space.names, space, strict=True)
    ]
    env = ReachEnv(DESCRIPTION, ParameterDistribution.point(space, np.array(values), 0.0), 1)
    env.reset(seed=0)
    reported = env.loop.position.copy()
    env._builder.joint_target[:] = reported
    zeros = np.zeros((1, 6))
    # e = 0.1 rad: 2 exp(-5) - 0.1.
    assert env.reward(reported, zeros, zeros, zeros) == pytest.approx(2 * np.exp(-5.0) - 0.1)
    assert env.reward(reported + 0.1, zeros, zeros, zeros) == pytest.approx(2.0)


def test_a_followed_pose_is_reached_up_to_the_arms_sag() -> None:
    """With the pose itself as target, joints without load arrive; weight bends the others."""
    env = _env(ticks=200, hold_ticks=100)
    env.reset(seed=0)
    for _ in range(99):
        env.step(_follow(env))
    off = np.abs(env.loop.position - env._builder.joint_target)
    assert off[:, [0, 4, 5]].max() < 0.03 and 0.01 < off[:, 1:3].max() < 0.2
