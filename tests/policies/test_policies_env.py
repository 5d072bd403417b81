"""The vectorised environment and the balancing task."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.cartpole_env import BalanceTask, CartPoleEnv, balance_spec
from deal_hw.policies.servo_loop import EXACT_SENSOR
from deal_hw.policy import ObservationBuilder

SPACE = k9_space()
POINT = ParameterDistribution.point(SPACE, SPACE.nominal, 0.01)
UNIFORM = ParameterDistribution.uniform(SPACE, (0.0, 0.03))


def exact_env(count: int = 1, **task: Any) -> CartPoleEnv:
    return CartPoleEnv(
        DESCRIPTION, POINT, count, task=BalanceTask(host_delay_s=(0.0, 0.0), **task), sensor=EXACT_SENSOR
    )


def test_reward_by_hand() -> None:
    """exp(-cost) - 1 with the cost added up by hand."""
    task = BalanceTask(angle_weight=5.0, speed_weight=0.1, position_weight=4.0, action_weight=0.5)
    env = CartPoleEnv(DESCRIPTION, POINT, 2, task=task)
    # 5 * 0.02 + 0.1 * 0.3 + 4 * 0.1^2 + 0.5 * (0.4 - 0.2)^2 = 0.1 + 0.03 + 0.04 + 0.02 = 0.19; and 0 at rest.
    reward = env.reward(
        np.array([[-0.1, 0.02], [0.0, 0.0]]),
        np.array([[-0.3, 9.0], [0.0, 0.0]]),
        np.array([[0.4], [0.0]]),
        np.array([[0.2], [0.0]]),
    )
    np.testing.assert_allclose(reward, [math.exp(-0.19) - 1.0, 0.0], atol=1e-12)


def test_same_seed_same_episode() -> None:
    """A seed fixes parameters, latencies, starts and noise; another seed gives another episode."""
    runs = []
    for seed in (5, 5, 6):
        env = CartPoleEnv(DESCRIPTION, UNIFORM, 4)
        observations = [env.reset(seed=seed)[0]]
        actions = np.random.default_rng(0).uniform(-1, 1, (30, 4, 1))
        observations += [env.step(action)[0] for action in actions]
        runs.append(np.stack(observations))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    assert runs[0].dtype == np.float32


def test_a_seed_that_cannot_be_used_is_refused() -> None:
    """A seed for each member, as other environments take, would fix nothing here."""
    with pytest.raises(gymnasium.error.Error, match="Seed must be a python integer"):
        exact_env(2).reset(seed=[1, 2])  # type: ignore[arg-type]


def test_every_member_draws_its_own_physics_and_draws_anew() -> None:
    """Members differ in parameters and latency, and one that falls comes back as another robot."""
    env = CartPoleEnv(DESCRIPTION, UNIFORM, 3)
    env.reset(seed=0)
    stiffness = env.loop.batch.servo_factor("servo_stiffness").copy()
    assert len(np.unique(stiffness)) == 3
    for _ in range(100):
        _, _, terminated, _, _ = env.step(np.array([[1.0], [0.0], [-1.0]]))
        if terminated.any():
            break
    assert terminated.any()
    changed = env.loop.batch.servo_factor("servo_stiffness") != stiffness
    assert changed[:, 0].tolist() == terminated.tolist()


def test_a_fallen_member_starts_anew_and_shows_its_last_observation() -> None:
    """The end gives the fall's cost; final_obs is beyond the limit; the next observation is a fresh start."""
    env = exact_env(2, end_angle_rad=0.1, fall_cost=7.0)
    env.reset(seed=0)
    for _ in range(60):
        observation, reward, terminated, truncated, info = env.step(np.ones((2, 1)))
        if terminated.any():
            break
    assert terminated.any()
    assert not truncated.any()
    i = int(np.flatnonzero(terminated)[0])
    sine = [t.quantity for t in env.layout.observation].index("sin_position")
    assert reward[i] == -7.0
    assert abs(info["final_obs"][i, sine]) > 10 * math.sin(0.1)
    assert abs(observation[i, sine]) <= 10 * math.sin(env.task.start_angle_rad) + 1e-6
    assert info["_final_obs"].tolist() == terminated.tolist()
    former = [k for k, t in enumerate(env.layout.observation) if t.quantity == "action"]
    np.testing.assert_array_equal(observation[i, former], 0.0)


def test_the_end_of_one_member_leaves_the_history_of_the_others() -> None:
    """While others start anew, a member observes what the robot's own builder would make of its states."""
    env = exact_env(2, end_angle_rad=0.3)
    observation, _ = env.reset(seed=1)
    alone = ObservationBuilder(env.layout)
    ends = 0
    reported = env.loop.reported_position[1], env.loop.reported_velocity[1]
    np.testing.assert_array_equal(observation[1], alone.build(*reported))
    for tick in range(40):
        angle, rate = env.loop.position[1, 1], env.loop.velocity[1, 1]
        action = np.array([[1.0 if tick % 2 else -1.0], [float(np.clip(4 * angle + 0.7 * rate, -1, 1))]])
        action[0] = 1.0
        observation, _, terminated, _, _ = env.step(action)
        ends += int(terminated[0])
        if terminated[1]:
            break
        alone.record_action(action[1])
        reported = env.loop.reported_position[1], env.loop.reported_velocity[1]
        np.testing.assert_array_equal(observation[1], alone.build(*reported))
    assert ends >= 1
    assert tick >= 20


def test_an_episode_is_cut_off_without_being_failed() -> None:
    """After the given ticks an upright member is truncated, not terminated, and counting starts again."""
    env = exact_env(1, ticks=3, start_angle_rad=0.0, start_position_m=0.0)
    env.reset(seed=0)
    flags = [env.step(np.zeros((1, 1)))[2:4] for _ in range(6)]
    assert [bool(t[0]) for t, _ in flags] == [False] * 6
    assert [bool(c[0]) for _, c in flags] == [False, False, True, False, False, True]


def test_the_share_of_an_episode_before_a_fall_is_measured() -> None:
    """1 where no member falls; one tick of ten where each falls at once; nothing before the first end."""
    for end_angle_rad, share in ((0.5, 1.0), (1e-9, 0.1)):
        env = exact_env(3, ticks=10, end_angle_rad=end_angle_rad)
        env.reset(seed=0)
        assert env.measures() == {}
        for _ in range(10):
            env.step(np.zeros((3, 1)))
        assert env.measures() == {"time_up": pytest.approx(share)}


def test_host_delay_adds_to_the_latency() -> None:
    """10 ms of the robot and 6 ms of the host: the target of the first tick acts from the 17th step on."""
    task = BalanceTask(host_delay_s=(0.006, 0.006), start_angle_rad=0.0, start_position_m=0.0)
    env = CartPoleEnv(DESCRIPTION, POINT, 1, task=task, sensor=EXACT_SENSOR)
    env.reset(seed=0)
    env.step(np.ones((1, 1)))
    # In the 4 steps that are left the set-point moves 4 mm; P = 80 N/m then pulls with 0.32 N at most,
    # against 0.3 N.
    assert 0.0 < env.loop.position[0, 0] < 1e-4


def test_actions_beyond_the_range_are_clipped() -> None:
    """An action of 50 does what an action of 1 does."""
    states = []
    for size in (1.0, 50.0):
        env = exact_env()
        env.reset(seed=0)
        env.step(np.full((1, 1), size))
        states.append(env.loop.position)
    np.testing.assert_array_equal(states[0], states[1])


def test_spec_fits_the_robot_and_names_the_distribution() -> None:
    """What is trained here can be deployed there, and says what it was trained under."""
    env = CartPoleEnv(DESCRIPTION, UNIFORM, 1)
    env.layout.check_fits(DESCRIPTION)
    assert env.layout.trained_under == UNIFORM.digest()
    assert env.single_observation_space.shape == (len(env.layout.observation),)
    assert balance_spec(DESCRIPTION, env.task).action_scale == (env.task.action_scale_m,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ticks": 0}, "ticks must be at least 1, got 0"),
        ({"end_angle_rad": -1.0}, "end_angle_rad must be positive, got -1.0"),
        ({"host_delay_s": (0.01, 0.0)}, "host_delay_s must be"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: dict[str, object], message: str) -> None:
    """The message names the setting and what was given."""
    with pytest.raises(ConfigurationError, match=message):
        BalanceTask(**settings)  # type: ignore[arg-type]
