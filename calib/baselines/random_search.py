"""`random`: draw parameters uniformly and keep the best; a search has to beat it with as many simulations."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import Members, cut, explained, whitened_residual
from deal_hw.calib.data.search import NoSettings, Search, SearchLog, Stepper
from deal_hw.calibration import CalibrationResult

TICKS = 10
"""Window length in control periods."""

ELITE = 10
"""Size of the result's population, best first."""


class _Random(Stepper):
    """A run of `random`: each generation draws one population and keeps the best."""

    STATE = ("_unit", "_score")

    settings: NoSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._windows = cut(log.problem, TICKS)
        # One metric for all draws, that of the range's midpoint: otherwise scores are not comparable.
        self._middle = self.coordinates.midpoint
        self._unit = np.empty((0, self.coordinates.count))
        self._score = np.empty(0)

    @property
    def finished(self) -> bool:
        """Whether the budget's draws, or those of one generation, were made."""
        return len(self.log.trace) >= max(self.log.budget.generations, 1)

    def step(self) -> None:
        """Draw and score one population."""
        unit = self.coordinates.sample(self.rng, self.log.budget.population)
        members = self.coordinates.members(unit)
        residual = whitened_residual(self.problem, members, self._middle, self._windows, population=True)
        score = np.mean(np.abs(residual), axis=1)
        score = np.where(np.isfinite(score), score, np.inf)
        units, scores = np.concatenate([self._unit, unit]), np.concatenate([self._score, score])
        order = np.argsort(scores, kind="stable")[:ELITE]
        self._unit, self._score = units[order], scores[order]
        values = {"best": float(score.min())}
        self.log.note(f"best {self._score[0]:.3g}", members, values)

    def result(self) -> CalibrationResult:
        elite = self.coordinates.members(self._unit)
        best = Members(elite.theta[:1], elite.latency_s[:1])
        return self.log.result(
            best,
            elite,
            chi2=explained(self.problem, best, TICKS),
            extra={"interval": "spread of the best draws, uncalibrated"},
        )


@dataclass(frozen=True)
class RandomSearch(Search):
    """Draw uniformly, score by the mean absolute whitened window innovation, return the best member.

    The budget's population times generations are the draws.
    """

    name = "random"
    stepper = _Random
    settings: NoSettings = field(default_factory=NoSettings)
