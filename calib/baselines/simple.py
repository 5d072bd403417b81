"""Baselines that bound the value of a method: some ignore the recording, one draws at random.

`midpoint` and `nominal` are the no-data baselines of every table: a method that does not beat them has
learned nothing from the data.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import Members, cut, explained, whitened_residual
from deal_hw.calib.search.base import Search, SearchLog, Stepper
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoSettings:
    """Settings of a method that has none."""


class _Draw(Stepper):
    """One generation: the population is a uniform draw, so that the interval is the range's."""

    STATE = ("_unit",)

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Ignorant) -> None:
        super().__init__(log, rng, search)
        self._unit = self.coordinates.sample(rng, max(log.budget.population, 2))
        self._estimate = search.estimate(self.problem.space)

    @property
    def finished(self) -> bool:
        """Whether the one generation was noted."""
        return bool(self.log.trace)

    def step(self) -> None:
        """Note the draw."""
        self.log.note("no data is read", self.coordinates.members(self._unit), {})

    def result(self) -> CalibrationResult:
        middle = self.coordinates.clip_latency(0.5 * sum(self.problem.latency_range_s))
        return self.log.result(
            Members(self._estimate[None], np.array([middle])),
            self.coordinates.members(self._unit),
            extra={"interval": "the range, uncalibrated"},
        )


class Ignorant(Search, abc.ABC):
    """A method that reads no data; its interval is the whole range."""

    stepper = _Draw
    settings = NoSettings()

    @abc.abstractmethod
    def estimate(self, space: ParameterSpace) -> FloatArray:
        """Return the estimate, (K,)."""


class Midpoint(Ignorant):
    """The midpoint of every range, in the range's own scale."""

    name = "midpoint"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """See :meth:`Ignorant.estimate`."""
        return space.center


class LinearMidpoint(Ignorant):
    """The midpoint of every range on a linear scale."""

    name = "midpoint-linear"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """See :meth:`Ignorant.estimate`."""
        return np.asarray((space.low + space.high) / 2)


class Nominal(Ignorant):
    """The values of the user's own model."""

    name = "nominal"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """See :meth:`Ignorant.estimate`."""
        return space.nominal


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomSettings:
    """Settings of `random`.

    Attributes:
        ticks: Window length in control periods.
        elite: Size of the result's population, best first; at least 2.
    """

    ticks: int = 10
    elite: int = 10


class _Random(Stepper):
    """A run of `random`: each generation draws one population and keeps the best."""

    STATE = ("_unit", "_score")

    settings: RandomSettings

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._windows = cut(log.problem, self.settings.ticks)
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
        residual = whitened_residual(self.problem, members, self._middle, self._windows)
        score = np.mean(np.abs(residual), axis=1)
        score = np.where(np.isfinite(score), score, np.inf)
        units, scores = np.concatenate([self._unit, unit]), np.concatenate([self._score, score])
        order = np.argsort(scores, kind="stable")[: max(self.settings.elite, 2)]
        self._unit, self._score = units[order], scores[order]
        values = {"best": float(score.min())}
        self.log.note(f"best {self._score[0]:.3g}", members, values)

    def result(self) -> CalibrationResult:
        elite = self.coordinates.members(self._unit)
        best = Members(elite.theta[:1], elite.latency_s[:1])
        return self.log.result(
            best,
            elite,
            chi2=explained(self.problem, best, self.settings.ticks),
            extra={"interval": "spread of the best draws, uncalibrated"},
        )


@dataclass(frozen=True)
class RandomSearch(Search):
    """Draw uniformly, score by the mean absolute whitened window innovation, return the best member.

    The budget's population times generations are the draws.
    """

    name = "random"
    stepper = _Random
    settings: RandomSettings = field(default_factory=RandomSettings)
