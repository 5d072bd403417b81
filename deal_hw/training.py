"""Contract of training: an environment and a configuration in, a policy out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import numpy as np

from deal_hw.policy import Policy

EnvT = TypeVar("EnvT", contravariant=True)
ConfigT = TypeVar("ConfigT", contravariant=True)

TrainingProgress = Callable[[int, int, float], None]
"""Called with steps done, steps in total and the recent mean return."""


class PolicyTrainer(Protocol, Generic[EnvT, ConfigT]):
    """Trains a policy in an environment."""

    name: str

    def train(
        self, env: EnvT, config: ConfigT, rng: np.random.Generator, progress: TrainingProgress | None = None
    ) -> Policy:
        """Return the trained policy; the same generator state gives the same policy on the same machine."""
        ...
