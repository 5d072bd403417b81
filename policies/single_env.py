"""A task as a single Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from deal_hw.policies.vector_env import ServoVectorEnv
from deal_hw.policy import Observation
from deal_hw.types import FloatArray


class SingleEnv(gymnasium.Env[Observation, FloatArray]):
    """One member of a vector environment, for libraries that need single environments.

    Each ``reset`` draws new physics.

    Args:
        env: A vector environment of one member.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  gymnasium declares it so

    def __init__(self, env: ServoVectorEnv) -> None:
        self.batch = env
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; a seed fixes everything that follows."""
        super().reset(seed=seed, options=options)
        observation, info = self.batch.reset(seed=seed, options=options)
        return observation[0], info

    def step(self, action: FloatArray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action, (A,), for one control period; at the end the last observation is returned."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        # The batch restarts its member in the same step.
        seen = info["final_obs"] if info else observation
        return seen[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}
