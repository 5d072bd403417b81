"""The hand's task: what turning is worth, when the cube has fallen, what is observed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.drivers import parameter_spaces, robot_description
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.hand_env import HandEnv, TurnTask, turn_spec

HAND = robot_description("allegro")


@pytest.fixture(scope="module")
def env() -> HandEnv:
    """Return an environment of three hands with episodes of 0.4 s."""
    space = parameter_spaces("allegro")["default"]().with_ratio(1.5)
    return HandEnv(HAND, ParameterDistribution.uniform(space, (0.0, 0.02)), 3, task=TurnTask(ticks=20))


def test_turning_is_worth_its_rate_up_to_a_limit(env: HandEnv) -> None:
    """0.5 rad/s: 0.5 + 0.2; 3 rad/s counts as 1; 16 actions of 0.5 cost 0.01 x 16 x 0.25 = 0.04."""
    position, velocity = np.zeros((3, 22)), np.zeros((3, 22))
    velocity[:, 5] = (0.5, 3.0, -0.2)
    action = np.zeros((3, 16))
    action[2] = 0.5
    np.testing.assert_allclose(env.reward(position, velocity, action, action), [0.7, 1.2, -0.04])


def test_a_cube_below_the_palm_ends_the_episode(env: HandEnv) -> None:
    """The palm's top is at 0.011 m and the cube's centre 0.0325 m above what it lies on."""
    position = np.zeros((3, 22))
    position[:, 2] = (0.044, 0.019, -0.27)
    assert env.ended(position, np.zeros_like(position)).tolist() == [False, True, True]


def test_hands_that_hold_still_keep_their_cubes(env: HandEnv) -> None:
    """An episode of no action: nobody drops anything, and an episode is cut off at its end."""
    env.reset(seed=1)
    for _ in range(20):
        observation, _, terminated, truncated, _ = env.step(np.zeros((3, 16)))
        assert np.isfinite(observation).all() and not terminated.any()
    assert truncated.all()


def test_all_joints_and_the_cube_are_observed() -> None:
    """Height, three axes of gravity, heading and turning, 16 positions, velocities and actions."""
    spec = turn_spec(HAND, task=TurnTask(action_rad=0.3))
    assert len(spec.observation) == 1 + 9 + 3 * 16
    assert spec.action_scale == (0.3,) * 16
    spec.check_fits(HAND)


@pytest.mark.parametrize("settings", [{"ticks": 0}, {"fastest_rad_s": 0.0}, {"action_rad": -1.0}])
def test_settings_that_cannot_be_are_refused(settings: dict[str, float]) -> None:
    """An episode has a tick, and limits are positive."""
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        dataclasses.replace(TurnTask(), **settings)  # type: ignore[arg-type]
