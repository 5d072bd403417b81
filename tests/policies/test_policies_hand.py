"""The hand's task: targets, what turning to them is worth, when the cube has fallen, what is observed."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.demonstration import Demonstration
from deal_hw.policies.hand_env import HandEnv, TurnTask, turn_spec
from deal_hw.policies.locomotion import judge
from deal_hw.policy import Observation
from deal_hw.robots import parameter_spaces, robot_description
from deal_hw.rotations import rotation_between
from deal_hw.types import FloatArray

HAND = robot_description("allegro")


@pytest.fixture(scope="module")
def env() -> HandEnv:
    """Return an environment of three hands with episodes of 0.4 s."""
    space = parameter_spaces("allegro")["default"]().with_ratio(1.5)
    return HandEnv(HAND, ParameterDistribution.uniform(space, (0.0, 0.02)), 3, task=TurnTask(ticks=20))


def test_reward_by_hand(env: HandEnv) -> None:
    """Progress, alignment, place and effort: three cubes with targets at 1, 0.4 and -0.5 rad."""
    env.reset(seed=0)
    env.wanted[:] = 0.0
    env.wanted[:, 2] = 1.0, 0.4, -0.5
    position, velocity, nothing = np.zeros((3, 22)), np.zeros((3, 22)), np.zeros((3, 16))
    position[:, 2], position[:, :2] = 0.044, env.loop.position[:, :2]
    env.reward(position, velocity, nothing, nothing)
    # The first turns by 0.1 rad to its target; the second stays, 0.1 m from its place, with 16 actions of 0.5
    # after none; the third turns away by 0.2 rad.
    position[:, 5], position[1, 0] = (0.1, 0.0, 0.2), position[1, 0] + 0.1
    action = nothing.copy()
    action[1] = 0.5
    wanted = [
        20 * 0.1 + 1 / (1 + 0.9 / 0.4) + 0.1,
        0.5 + 0.1 - 50 * 0.01 - 2 * 0.005 * 16 * 0.25,
        -20 * 0.2 + 1 / (1 + 0.7 / 0.4) + 0.1,
    ]
    np.testing.assert_allclose(env.reward(position, velocity, action, nothing), wanted, atol=1e-9)


def test_outcomes_are_the_angle_and_whether_a_cube_that_is_held_is_near(env: HandEnv) -> None:
    """0.39 rad is aligned, 0.41 is not, and a cube that fell at its target is not either."""
    env.reset(seed=0)
    env.wanted[:] = 0.0
    position, nothing = np.zeros((3, 22)), np.zeros((3, 16))
    position[:, 2], position[:, 5] = (0.044, 0.044, 0.0), (0.39, -0.41, 0.0)
    env.reward(position, np.zeros_like(position), nothing, nothing)
    found = env.outcomes()
    np.testing.assert_allclose(found["rotation_error_rad"], [0.39, 0.41, 0.0])
    assert found["aligned"].tolist() == [1.0, 0.0, 0.0]


def test_targets_are_drawn_to_both_sides_and_observed() -> None:
    """Of 200 within a quarter turn, about half are to the left; the policy sees the rotation that is left."""
    space = parameter_spaces("allegro")["default"]()
    env = HandEnv(HAND, ParameterDistribution.uniform(space.with_ratio(1.5), (0.0, 0.0)), 200)
    observation, _ = env.reset(seed=2)
    left = rotation_between(env.loop.position[:, 3:6], env.wanted)
    assert 70 < (left[:, 2] > 0).sum() < 130
    assert 1.4 < np.abs(left[:, 2]).max() <= math.pi / 2
    np.testing.assert_allclose(left[:, :2], 0.0, atol=1e-9)
    seen = [k for k, term in enumerate(env.layout.observation) if term.quantity == "target_rotation"]
    np.testing.assert_allclose(observation[:, seen], left, atol=1e-6)


def test_a_demonstration_has_a_target_and_the_same_observation() -> None:
    """By default the cube is to turn left by one radian; the policy sees it as in training."""
    seen: list[Observation] = []

    class Rest:
        """A policy that does nothing, and remembers what it saw."""

        spec = turn_spec(HAND)

        def act_batch(self, observations: Observation) -> FloatArray:
            seen.append(observations)
            return np.zeros((len(observations), 16))

    position = np.zeros(22)
    position[:3], position[5], position[6:] = (0.02, 0.0, 0.044), 0.3, HAND.default_position
    Demonstration(Rest(), HAND)(position, np.zeros(22), 0.0)
    # Place 20 times, the rotation that is left, gravity, the world's x axis as the turned cube sees it.
    wanted = [0.4, 0, 0.88, 0, 0, 0.7, 0, 0, -1, math.cos(0.3), -math.sin(0.3), 0]
    np.testing.assert_allclose(seen[0][0, :12], wanted, atol=1e-6)


def test_the_judge_reports_how_episodes_end(env: HandEnv) -> None:
    """Hands that hold still: a target is reached by those that drew one nearby, and no cube is dropped."""

    class Rest:
        """A policy that does nothing."""

        spec = env.layout

        def act_batch(self, observations: Observation) -> FloatArray:
            return np.zeros((len(observations), 16))

    found = judge(Rest(), env, 5)
    env.reset(seed=5)
    drawn = np.linalg.norm(rotation_between(env.loop.position[:, 3:6], env.wanted), axis=1)
    assert found["fall_rate"] == 0.0
    assert found["outcomes"]["rotation_error_rad"] == pytest.approx(drawn.mean(), abs=0.02)
    assert found["outcomes"]["aligned"] == pytest.approx((drawn < 0.4).mean())


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
    """Place, rotation left, gravity, heading, two velocities; 16 positions, velocities and actions."""
    spec = turn_spec(HAND, task=TurnTask(spread_rad=0.3, bend_rad=0.6))
    assert len(spec.observation) == 6 * 3 + 3 * 16
    assert spec.action_scale == (0.3, 0.6, 0.6, 0.6) * 4
    spec.check_fits(HAND)


@pytest.mark.parametrize("settings", [{"ticks": 0}, {"tolerance_rad": 0.0}, {"bend_rad": -1.0}])
def test_settings_that_cannot_be_are_refused(settings: dict[str, float]) -> None:
    """An episode has a tick, and limits are positive."""
    with pytest.raises(ConfigurationError, match=next(iter(settings))):
        dataclasses.replace(TurnTask(), **settings)  # type: ignore[arg-type]
