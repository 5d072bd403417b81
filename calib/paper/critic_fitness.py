"""The paper's fitness: a critic, trained against the population's rollouts, scores each member's own."""

from __future__ import annotations

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.paper.critic import ClippedCritic
from deal_hw.calib.paper.fitness import Fitness, RolloutView, Samples
from deal_hw.sim.engine.batch import default_threads
from deal_hw.types import FloatArray


class CriticFitness(Fitness):
    """Rollouts, replay and critic: lines 3 to 9 of Algorithm 1."""

    STATE = ("_critic", "_replay")

    def _prepare(self, rng: np.random.Generator) -> None:
        settings = self._settings
        self._view = RolloutView(self._problem, settings, rng)
        self._critic = ClippedCritic(
            self._view.real.shape[1],
            settings.critic,
            rng,
            self._problem.threads or default_threads(),
        )
        self._replay: list[Samples] = []

    def score(self, members: Members) -> FloatArray:
        """Train the critic on these members and return each one's mean output, (N,)."""
        rollouts, usable = self._view.rollouts(members)
        N, _, width = rollouts.shape
        self._replay.append(rollouts[usable].reshape(-1, width))
        gap = self._critic.train(self._view.real, *self._replay)
        score = self._critic.score(rollouts.reshape(-1, width))
        keep = self._settings.replay_generations
        if keep is not None:
            # Old rollouts are dropped before the checkpoint is saved.
            del self._replay[: max(len(self._replay) - keep + 1, 0)]
        self.values = {"wasserstein": gap}
        # Line 9: the expectation over the member's own rollout.
        mean = score.reshape(N, -1).mean(axis=1).astype(np.float64)
        return np.where(usable, mean, -np.inf)
