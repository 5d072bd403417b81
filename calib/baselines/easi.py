"""`easi`: evolution strategy against a critic (EASI, Dong et al., NeurIPS 2024), the paper's first baseline.

Each generation rolls every member out, trains the critic on these rollouts and scores them by it. Then it
fits a diagonal Gaussian to the better half and draws the next generation from it. There is neither step-size
control nor a covariance: the spread of the elites is the step.

Written from the method's description and the constants of its published program (population, survival rate,
weights, critic). Deviations are noted in place.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from deal_hw.calib.baselines.scored import ScoredStepper
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.resume import Stateful
from deal_hw.calib.data.search import RangedSearch, Search, SearchLog
from deal_hw.calib.paper.critic import CriticSettings
from deal_hw.calib.paper.fitness import FitnessSettings
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

BATCH_PER_MEMBER = 16
"""Transitions in a batch of the critic per member of the population (16)."""

CRITIC = CriticSettings(hidden=(128, 128))
"""The published program's: two layers of 128, RMSprop 3e-4, clip 0.01, 20 updates a generation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EasiSettings:
    """Settings of `easi`.

    Attributes:
        fitness: Name of the fitness; EASI's is the critic.
        survive_rate: Share of elites; at most a half, beyond which weights are negative.
        linear: Whether the range is linear, as published; then one of ratio xi^2 has its midpoint at half its
            upper end. Off is uniform in each parameter's own scale (log for positive ones).
    """

    latency: ClassVar[bool] = False  # EASI has no latency among its coordinates.

    fitness: str = "critic"
    survive_rate: float = 0.5
    linear: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.survive_rate <= 0.5:
            raise ConfigurationError(f"survive_rate must be within (0, 0.5], got {self.survive_rate:g}")


def elite_weights(population: int, elites: int) -> FloatArray:
    """Return the weights of the elites of N members, best first, (elites,), at most N / 2; they sum to 1."""
    raw = np.log(0.5 * (population + 1)) - np.log(np.arange(1, elites + 1))
    return np.asarray(raw / raw.sum())


class EliteGaussian(Stateful):
    """A diagonal Gaussian in the unit cube that is fitted to the best members of its own sample.

    The first members, (N, C), are drawn uniformly.
    """

    STATE = ("_population", "mean", "std")

    def __init__(self, population: FloatArray, survive_rate: float, rng: np.random.Generator) -> None:
        if len(population) < 2:
            raise ConfigurationError(f"a population of {len(population)} has no elite; use 2 members or more")
        self._rng = rng
        self._elites = max(int(survive_rate * len(population)), 1)
        self._population = np.array(population, dtype=float)
        self.mean = self._population.mean(axis=0)
        self.std = self._population.std(axis=0)

    def ask(self) -> FloatArray:
        """Return the population, (N, C), inside the unit cube."""
        return self._population.copy()

    def tell(self, fitness: FloatArray) -> None:
        """Fit the elites and draw the next population; fitness (N,), not finite for no elite.

        The published program takes the first half of the random start as its first elite, without a look at
        fitness; here the first generation is scored like the others.
        """
        usable = np.flatnonzero(np.isfinite(fitness))
        if usable.size:
            # Stable, so that equal members keep their order on every machine.
            order = usable[np.argsort(-fitness[usable], kind="stable")][: self._elites]
            elites = self._population[order]
            weights = elite_weights(len(fitness), len(elites))
            self.mean = weights @ elites
            self.std = np.sqrt(weights @ (elites - self.mean) ** 2)
        draw = self._rng.standard_normal(self._population.shape)
        self._population = np.clip(self.mean + self.std * draw, 0.0, 1.0)


class _Easi(ScoredStepper):
    settings: EasiSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        settings = self.settings
        # The latency's coordinate is drawn without its margin, all others uniformly.
        start = self.coordinates.sample(rng, log.budget.population)
        self._search = EliteGaussian(start, settings.survive_rate, rng)

    def scoring(self) -> FitnessSettings:
        batch = BATCH_PER_MEMBER * self.log.budget.population
        return FitnessSettings(critic=replace(CRITIC, batch=batch))

    def step(self) -> None:
        """Roll out, train the critic, score by the trained critic, select."""
        members = self.coordinates.members(self._search.ask())
        fitness, values = self.score(members)
        self._search.tell(fitness)
        spread = float(self._search.std.mean())
        self.log.note(f"spread {spread:.3g} of the range", members, {**values, "spread": spread})

    def found(self) -> tuple[Members, Members]:
        """Return the Gaussian's mean and its last sample."""
        mean = self._search.mean[None]
        return self.coordinates.members(mean), self.coordinates.members(self._search.ask())


@dataclass(frozen=True)
class Easi(RangedSearch):
    """EASI: critic, elites and a diagonal Gaussian."""

    stepper = _Easi
    settings: EasiSettings = field(default_factory=EasiSettings)
    name: str = "easi"


def logarithmic() -> Easi:
    """Return `easi-log`: EASI in steps of each parameter's own scale."""
    return Easi(EasiSettings(linear=False), name="easi-log")
