"""What the baselines that search by one score a member share: scoring, counting and the trace."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from deal_hw.calib.data.coordinates import Coordinates, Members
from deal_hw.calib.data.innovations import explained
from deal_hw.calib.deal_paper.fitness import FitnessSettings, make_fitness
from deal_hw.calib.deal_paper.rollouts import PopulationPolicy
from deal_hw.calib.search.base import Stepper
from deal_hw.calib.search.log import Run
from deal_hw.calibration import Alarm
from deal_hw.types import FloatArray

CHANGING = frozenset({"critic"})
"""Fitnesses that learn: numbers of different generations do not compare."""


class ScoredStepper(Stepper):
    """A run whose members are told one number each.

    Args:
        run: The run's book-keeping.
        rng: Seeds the fitness.
        fitness: Name of the fitness.
        settings: How to score; its horizon is also that of the residual that the result states.
        policy: pi_0 to run in the loop of the rollouts.
    """

    def __init__(
        self,
        run: Run,
        rng: np.random.Generator,
        fitness: str,
        settings: FitnessSettings,
        policy: PopulationPolicy | None = None,
    ) -> None:
        self.run = run
        self.coordinates = Coordinates(run.problem)
        self.fitness = make_fitness(fitness, run.problem, rng, settings, policy)
        self.stationary = fitness not in CHANGING
        self._ticks = settings.horizon_ticks

    @property
    def finished(self) -> bool:
        """Whether the budget's generations are used up."""
        return len(self.run.trace) >= self.run.budget.generations

    def score(self, members: Members) -> tuple[FloatArray, dict[str, float]]:
        """Score members and return their fitness, (N,), -inf where one diverged, and what the trace says."""
        fitness = np.asarray(self.fitness.score(members), dtype=float)
        usable = np.isfinite(fitness)
        finite = fitness[usable]
        return np.where(usable, fitness, -np.inf), {
            "fitness": float(finite.mean()) if finite.size else float("nan"),
            "best": float(finite.max()) if finite.size else float("nan"),
            "scored": float(len(fitness)),
            "diverged": float(np.sum(~usable)),
            **self.fitness.values,
        }

    def note(self, message: str, members: Members, values: Mapping[str, float]) -> None:
        """Write one generation into the trace; see :meth:`Run.note`."""
        searched = self.coordinates.fixed_latency_s is None
        self.run.note(message, members.theta, values, members.latency_s if searched else None)

    def residual(self, centre: Members) -> float:
        """Return the mean squared whitened residual of one member."""
        return explained(self.run.problem, centre, self._ticks)

    def alarms(self) -> list[Alarm]:
        """Return reasons to distrust the result: too many members that had no score."""
        scored = sum(row["scored"] for row in self.run.trace if "scored" in row)
        lost = sum(row["diverged"] for row in self.run.trace if "diverged" in row)
        if scored and lost > 0.5 * scored:
            return [
                Alarm(
                    f"{lost:.0f} of {scored:.0f} members diverged and had no score.",
                    "Simulations explode over much of the search range, and nothing was searched there.",
                    "Narrow the ranges (--range NAME LOW HIGH), or shorten the physics step.",
                )
            ]
        return []
