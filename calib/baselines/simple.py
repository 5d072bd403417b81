"""Baselines that bound what a method is worth: two that ignore the recording, and one that draws at random.

`centre` and `nominal` are the null rows of every table: a method that does not beat them has read nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.coordinates import Members
from deal_hw.calib.data.innovations import cut, explained, whitened_residual
from deal_hw.calib.search.base import Search, Stepper
from deal_hw.calib.search.log import SearchLog
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoSettings:
    """Settings of a method that has none."""


class Centre(Search):
    """Return the centre of every range, in the range's own scale; the interval is the range's."""

    name = "centre"
    settings = NoSettings()

    def begin(self, log: SearchLog, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Draw(log, rng, log.problem.space.center)


class Nominal(Search):
    """Return the values of the user's own model; the interval is the range's."""

    name = "nominal"
    settings = NoSettings()

    def begin(self, log: SearchLog, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Draw(log, rng, log.problem.space.nominal)


class _Draw(Stepper):
    """One generation: the population is a uniform draw, so that the interval is the range's."""

    KEPT = ("_unit",)

    def __init__(self, log: SearchLog, rng: np.random.Generator, estimate: FloatArray) -> None:
        super().__init__(log)
        self._unit = self.coordinates.sample(rng, max(log.budget.population, 2))
        self._estimate = estimate

    @property
    def finished(self) -> bool:
        """Whether the one generation was noted."""
        return bool(self.log.trace)

    def step(self) -> None:
        """Note the draw."""
        self.log.note("no data is read", self.coordinates.members(self._unit).theta, {})

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`."""
        middle = self.coordinates.clip_latency(0.5 * sum(self.problem.latency_range_s))
        return self.log.result(
            Members(self._estimate[None], np.array([middle])),
            self.coordinates.members(self._unit),
            extra={"interval": "the range, uncalibrated"},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSettings:
    """Settings of `random`.

    Attributes:
        ticks: Window length in control periods.
        elite: Members that make the population of the result, best first; at least 2.
    """

    ticks: int = 10
    elite: int = 10


@dataclass(frozen=True)
class RandomSearch(Search):
    """Draw uniformly, score by the mean absolute whitened window innovation, return the best member.

    The budget's population times generations are the draws.

    Attributes:
        settings: How to run.
    """

    name = "random"
    settings: RandomSettings = field(default_factory=RandomSettings)

    def begin(self, log: SearchLog, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Random(log, rng, self.settings)


class _Random(Stepper):
    """A run of `random`: one draw of a population a generation, of which the best are kept."""

    KEPT = ("_unit", "_score")

    def __init__(self, log: SearchLog, rng: np.random.Generator, settings: RandomSettings) -> None:
        super().__init__(log)
        self._rng, self._settings = rng, settings
        self._windows = cut(log.problem, settings.ticks)
        # One metric for all draws, that of the range's centre: scores of different metrics do not compare.
        self._middle = self.coordinates.members(np.full((1, self.coordinates.count), 0.5))
        self._unit = np.empty((0, self.coordinates.count))
        self._score = np.empty(0)

    @property
    def finished(self) -> bool:
        """Whether the budget's draws, or those of one generation, were made."""
        return len(self.log.trace) >= max(self.log.budget.generations, 1)

    def step(self) -> None:
        """Draw and score one population."""
        unit = self.coordinates.sample(self._rng, self.log.budget.population)
        members = self.coordinates.members(unit)
        residual = whitened_residual(self.problem, members, self._middle, self._windows)
        score = np.mean(np.abs(residual), axis=1)
        score = np.where(np.isfinite(score), score, np.inf)
        units, scores = np.concatenate([self._unit, unit]), np.concatenate([self._score, score])
        order = np.argsort(scores, kind="stable")[: max(self._settings.elite, 2)]
        self._unit, self._score = units[order], scores[order]
        values = {"best": float(score.min())}
        self.log.note(f"best {self._score[0]:.3g}", members.theta, values, members.latency_s)

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`."""
        elite = self.coordinates.members(self._unit)
        best = Members(elite.theta[:1], elite.latency_s[:1])
        return self.log.result(
            best,
            elite,
            chi2=explained(self.problem, best, self._settings.ticks),
            extra={"interval": "spread of the best draws, uncalibrated"},
        )
