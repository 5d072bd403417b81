"""The training task: its reward, its starts, and where it ends."""

from __future__ import annotations

import numpy as np
import pytest
from deal_hw_bench_cartpole.description import DESCRIPTION, parameter_space
from deal_hw_bench_cartpole.swing_up import SWING_UP, SwingUpEnv, SwingUpTask

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution


@pytest.fixture(name="env")
def environment() -> SwingUpEnv:
    """200 robots under the task's uniform domain randomisation."""
    space = parameter_space().with_ratio(SWING_UP.udr_ratio)
    made: SwingUpEnv = SWING_UP.make(
        DESCRIPTION, ParameterDistribution.uniform(space, SWING_UP.udr_latency_s), 200
    )
    return made


def test_the_reward_is_one_at_rest_upright_in_the_middle(env: SwingUpEnv) -> None:
    """Half of it for a pole that rushes through, little more than half at the track's end, none below."""
    position = np.array([[0.0, 0.0], [0.0, 0.0], [0.12, 2 * np.pi], [0.0, np.pi]])
    velocity = np.array([[0.0, 0.0], [0.0, 20.0], [0.0, 0.0], [0.0, 0.0]])
    still = np.zeros((4, 1))
    # The third: (1 + exp(-1)) / 2 = 0.684.
    wanted = [1.0, 0.5, 0.684, 0.0]
    np.testing.assert_allclose(env.reward(position, velocity, still, still), wanted, atol=1e-3)
    # A change of the action from -1 to 1 costs 0.02 * 4.
    ones = np.ones((4, 1))
    found = env.reward(position, velocity, ones, -ones)
    np.testing.assert_allclose(found, np.array(wanted) - 0.08, atol=1e-3)


def test_half_of_the_episodes_begin_hanging(env: SwingUpEnv) -> None:
    """The others begin at any angle, and no cart beyond the task's range."""
    position, velocity = env.start_state(np.random.default_rng(0), 10_000)
    near = np.abs(position[:, 1] - np.pi) < 0.6
    assert 0.5 < near.mean() < 0.65
    assert np.abs(position[:, 0]).max() <= 0.08
    assert np.abs(velocity[:, 1]).max() <= 8.0


def test_a_cart_near_the_end_of_the_track_ends_the_episode(env: SwingUpEnv) -> None:
    """On either side, before the driver's limit of 0.19 m."""
    position = np.array([[0.17, 0.0], [0.181, 0.0], [-0.181, 3.0]])
    assert env.ended(position, np.zeros((3, 2))).tolist() == [False, True, True]


def test_a_share_above_one_is_refused() -> None:
    """The message says what is allowed."""
    with pytest.raises(ConfigurationError, match="hanging_share must be 0 to 1"):
        SwingUpTask(hanging_share=1.5)
