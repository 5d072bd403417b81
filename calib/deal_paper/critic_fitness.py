"""The paper's fitness: a critic, trained against the population's rollouts, scores each member's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from deal_hw.calib.data.coordinates import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.deal_paper.fitness import FitnessSettings, RolloutView, Samples
from deal_hw.calib.deal_paper.rollouts import PopulationPolicy
from deal_hw.calib.search.critic import ClippedCritic, CriticSettings, torch_threads
from deal_hw.types import FloatArray


class CriticFitness:
    """Rollouts, replay and critic: lines 3 to 9 of Algorithm 1.

    Args:
        problem: Data and simulator.
        settings: Critic, replay, length of rollouts.
        policy: pi_0 to run in the loop; None replays its recorded actions.
        rng: Seeds the critic.
    """

    def __init__(
        self,
        problem: Problem,
        settings: FitnessSettings,
        policy: PopulationPolicy | None,
        rng: np.random.Generator,
    ) -> None:
        self._settings = settings
        self._view = RolloutView(problem, settings.ticks, policy)
        self._critic = ClippedCritic(self._view.real.shape[1], settings.critic or CriticSettings(), rng)
        self._replay: list[Samples] = []
        self.values: dict[str, float] = {}

    def score(self, members: Members) -> FloatArray:
        """Train the critic on these members and return each one's mean output, (N,)."""
        rollouts, usable = self._view.rollouts(members)
        N, _, width = rollouts.shape
        self._replay.append(rollouts[usable].reshape(-1, width))
        if self._settings.replay_generations is not None:
            del self._replay[: -self._settings.replay_generations]
        with torch_threads(self._settings.torch_threads):
            gap = self._critic.train_on_blocks(self._view.real, self._replay)
            score = self._critic.score(rollouts.reshape(-1, width))
        self.values = {"wasserstein": gap}
        # Line 9: the expectation over the member's own rollout.
        mean = score.reshape(N, -1).mean(axis=1).astype(np.float64)
        return np.where(usable, mean, -np.inf)

    def save(self) -> dict[str, Any]:
        """Return the critic, and the replay as far as the next generation is trained on it."""
        keep = self._settings.replay_generations
        first = 0 if keep is None else max(len(self._replay) - keep + 1, 0)
        return {"critic": self._critic.save(), "replay": self._replay[first:]}

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`save` returned."""
        self._critic.load(state["critic"])
        self._replay = list(state["replay"])
