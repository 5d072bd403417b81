"""Checks the registered tasks with Gymnasium's and stable-baselines3's checkers; trains a kept model on."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import gymnasium
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import deal_hw.workflows.environments  # noqa: F401  registers the tasks

STEPS = 5
"""Steps of the training that goes on: each costs the gradient steps of a whole batch."""


def main(model: Path) -> None:
    """Check all tasks, single and vector, and the model that training left."""
    names = [name for name in gymnasium.registry if name.startswith("deal_hw/")]
    with warnings.catch_warnings():
        # Observations have no bounds, and nothing is rendered.
        warnings.simplefilter("ignore")
        for name in names:
            env = gymnasium.make(name).unwrapped
            check_env(env, skip_render_check=True)
            sb3_check_env(env)
            batch = gymnasium.make_vec(name, num_envs=3)
            seen, _ = batch.reset(seed=0)
            if seen not in batch.observation_space:
                raise AssertionError(f"{name}: observations {seen.shape}")
        loaded = SAC.load(model, env=gymnasium.make("deal_hw/CartPole-v0"), device="cpu")
        loaded.learn(STEPS, reset_num_timesteps=False)
    print(f"{', '.join(names)}; SAC goes on from step {loaded.num_timesteps - STEPS}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
