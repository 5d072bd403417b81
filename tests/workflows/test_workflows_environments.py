"""The training tasks as Gymnasium environments, by the checkers of Gymnasium and stable-baselines3."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.policies.single_env import SingleEnv
from deal_hw.robots import robots
from deal_hw.workflows import environments
from deal_hw.workflows.train import udr_distribution

IDS = [entry.environment for entry in robots().entries() if entry.environment]


@pytest.mark.parametrize("name", IDS)
def test_checkers_accept_every_task(name: str) -> None:
    """Spaces, seeds, determinism, types of what reset and step return."""
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    env = gymnasium.make(name)
    with warnings.catch_warnings():
        # Observations have no bounds, and nothing is rendered.
        warnings.simplefilter("ignore")
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env.unwrapped)


def test_vector_and_single_are_the_same_task() -> None:
    """With one seed a batch of one and the single environment see the same; the end shows the last sight."""
    single = gymnasium.make("deal_hw/CartPole-v0").unwrapped
    batch = gymnasium.make_vec("deal_hw/CartPole-v0", num_envs=1)
    seen, _ = single.reset(seed=4)
    seen_too, _ = batch.reset(seed=4)
    np.testing.assert_array_equal(seen, seen_too[0])
    for _ in range(300):
        seen, reward, terminated, truncated, _ = single.step(np.ones(1, dtype=np.float32))
        seen_too, rewards, terminated_too, _, info = batch.step(np.ones((1, 1), dtype=np.float32))
        assert (reward, terminated) == (rewards[0], terminated_too[0])
        if terminated or truncated:
            break
        np.testing.assert_array_equal(seen, seen_too[0])
    assert terminated
    np.testing.assert_array_equal(seen, info["final_obs"][0])
    assert not np.array_equal(seen, seen_too[0])


def test_a_calibrated_distribution_is_what_is_drawn_from(tmp_path: Path) -> None:
    """As a file, as deal-hw calibrate writes it, or as an object; a wrong file is refused."""
    space = udr_distribution("cartpole").space
    point = ParameterDistribution.point(space, space.nominal, 0.01)
    file = tmp_path / "distribution.json"
    file.write_text(json.dumps(point.to_json()))
    for given in (point, file, str(file)):
        env = gymnasium.make("deal_hw/CartPole-v0", distribution=given).unwrapped
        assert isinstance(env, SingleEnv) and env.batch.distribution.digest() == point.digest()
    file.write_text("{}")
    with pytest.raises(ConfigurationError, match=r"distribution\.json"):
        gymnasium.make("deal_hw/CartPole-v0", distribution=file)


def test_registration_can_be_repeated() -> None:
    """A second call is no error, and Gymnasium's way to name a module works."""
    environments.register()
    assert set(IDS) <= set(gymnasium.registry)
    named = gymnasium.make("deal_hw.workflows.environments:deal_hw/CartPole-v0")
    assert named.observation_space.shape == gymnasium.make("deal_hw/CartPole-v0").observation_space.shape
