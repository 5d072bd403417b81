"""Baselines that bound what a method is worth: two that ignore the recording, and one that draws at random.

`centre` and `nominal` are the null rows of every table: a method that does not beat them has read nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.coordinates import Coordinates, Members
from deal_hw.calib.innovations import cut, explained, whitened_residual
from deal_hw.calib.outcome import Run
from deal_hw.calib.problem import Problem
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoSettings:
    """Settings of a method that has none."""


class Centre(CalibrationMethod[Problem]):
    """Return the centre of every range, in the range's own scale, and the whole range as interval."""

    name = "centre"

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Look at nothing; the population is a uniform draw, so that the interval is the range's."""
        return _ignorant(self.name, problem, budget, rng, progress, problem.space.center)


class Nominal(CalibrationMethod[Problem]):
    """Return the values of the user's own model, and the whole range as interval."""

    name = "nominal"

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Look at nothing."""
        return _ignorant(self.name, problem, budget, rng, progress, problem.space.nominal)


def _ignorant(
    name: str,
    problem: Problem,
    budget: Budget,
    rng: np.random.Generator,
    progress: ProgressCallback | None,
    estimate: FloatArray,
) -> CalibrationResult:
    run = Run(name, problem, budget, progress)
    coordinates = Coordinates(problem)
    population = coordinates.members(coordinates.sample(rng, max(budget.population, 2)))
    middle = 0.5 * sum(problem.latency_range_s)
    centre = Members(estimate[None], np.array([coordinates.clip_latency(middle)]))
    run.note("no data is read", population.theta, {})
    return run.result(
        coordinates, centre, population, settings=NoSettings(), extra={"interval": "the range, uncalibrated"}
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSettings:
    """Settings of `random`.

    Attributes:
        ticks: Window length in control periods.
        elite: Members that make the population of the result, best first.
    """

    ticks: int = 10
    elite: int = 10


class RandomSearch(CalibrationMethod[Problem]):
    """Draw uniformly, score by the mean absolute whitened window innovation, return the best member."""

    name = "random"

    def __init__(self, settings: RandomSettings | None = None) -> None:
        self.settings = settings or RandomSettings()

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Use the budget's population times generations as draws."""
        run = Run(self.name, problem, budget, progress)
        coordinates = Coordinates(problem)
        windows = cut(problem, self.settings.ticks)
        middle = coordinates.members(np.full((1, coordinates.count), 0.5))
        kept: list[FloatArray] = []
        scores: list[FloatArray] = []
        for _ in range(max(budget.generations, 1)):
            unit = coordinates.sample(rng, budget.population)
            members = coordinates.members(unit)
            # One metric for all draws, that of the range's centre: scores of different metrics do not
            # compare.
            score = np.mean(np.abs(whitened_residual(problem, members, middle, windows)), axis=1)
            kept.append(unit)
            scores.append(np.where(np.isfinite(score), score, np.inf))
            run.note(
                f"best {min(s.min() for s in scores):.3g}", members.theta, {"best": float(scores[-1].min())}
            )
        order = np.argsort(np.concatenate(scores))[: max(self.settings.elite, 2)]
        elite = coordinates.members(np.concatenate(kept)[order])
        best = Members(elite.theta[:1], elite.latency_s[:1])
        return run.result(
            coordinates,
            best,
            elite,
            settings=self.settings,
            chi2=explained(problem, best, self.settings.ticks),
            extra={"interval": "spread of the best draws, uncalibrated"},
        )
