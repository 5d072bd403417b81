"""Common part of baselines that search by one score per member: scoring, counting and the trace."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import numpy as np

from deal_hw.calib.data.innovations import Members, explained
from deal_hw.calib.data.search import Search, SearchLog, Stepper
from deal_hw.calib.paper.fitness import FitnessSettings, make_fitness
from deal_hw.calibration import CalibrationResult
from deal_hw.findings import Finding
from deal_hw.types import FloatArray

CHANGING = frozenset({"critic"})
"""Fitnesses that learn: their numbers are not comparable between generations."""


class ScoredStepper(Stepper):
    """A run whose search sees one number per member.

    The settings name the fitness; its window is also that of the stated residual.
    """

    STATE: ClassVar[tuple[str, ...]] = ("_search", "_fitness")
    INTERVAL = "population spread, uncalibrated"

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        name = self.settings.fitness
        self._fitness = make_fitness(name, self.problem, rng, self.scoring())
        self.stationary = name not in CHANGING

    def scoring(self) -> FitnessSettings:
        """Return how the fitness scores."""
        return FitnessSettings()

    @abc.abstractmethod
    def found(self) -> tuple[Members, Members]:
        """Return the estimate, one member, and the population of the result."""

    @property
    def finished(self) -> bool:
        """Whether the budget's generations are used up."""
        return len(self.log.trace) >= self.log.budget.generations

    def score(self, members: Members) -> tuple[FloatArray, dict[str, float]]:
        """Score members; return their fitness, (N,), -inf where one diverged, and values for the trace."""
        fitness = np.asarray(self._fitness.score(members), dtype=float)
        usable = np.isfinite(fitness)
        finite = fitness[usable]
        return np.where(usable, fitness, -np.inf), {
            "fitness": float(finite.mean()) if finite.size else float("nan"),
            "best": float(finite.max()) if finite.size else float("nan"),
            "scored": float(len(fitness)),
            "diverged": float(np.sum(~usable)),
            **self._fitness.values,
        }

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`; there is an alarm where too many members had no score."""
        centre, population = self.found()
        scored = sum(row["scored"] for row in self.log.trace)
        lost = sum(row["diverged"] for row in self.log.trace)
        alarm = Finding.alarm(
            f"{lost:.0f} of {scored:.0f} members diverged and had no score.",
            "Simulations diverge over much of the search range, and nothing was searched there.",
            "Narrow the ranges (--range NAME LOW HIGH), or shorten the physics step.",
        )
        return self.log.result(
            centre,
            population,
            chi2=explained(self.problem, centre, self.scoring().window_ticks),
            alarms=(alarm,) if lost > 0.5 * scored else (),
            extra={"interval": self.INTERVAL, **self.facts()},
        )

    def facts(self) -> dict[str, Any]:
        """Return further entries of the provenance."""
        return {}
