"""Baselines that bound what a method is worth: two that ignore the recording, and one that draws at random.

`centre` and `nominal` are the null rows of every table: a method that does not beat them has read nothing.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.coordinates import Coordinates, Members
from deal_hw.calib.data.innovations import cut, explained, whitened_residual
from deal_hw.calib.search.base import Search, Stepper
from deal_hw.calib.search.checkpoint import State
from deal_hw.calib.search.log import Run
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoSettings:
    """Settings of a method that has none."""


@dataclass(frozen=True)
class _Ignorant(Search):
    """A method that looks at nothing and states the whole range as interval.

    Attributes:
        settings: None.
    """

    settings: NoSettings = field(default_factory=NoSettings)

    @abc.abstractmethod
    def estimate(self, space: ParameterSpace) -> FloatArray:
        """Return the estimate, (K,)."""

    def begin(self, run: Run, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Draw(run, rng, self.estimate(run.problem.space))


class Centre(_Ignorant):
    """Return the centre of every range, in the range's own scale."""

    name = "centre"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """Return the centre."""
        return space.center


class Nominal(_Ignorant):
    """Return the values of the user's own model."""

    name = "nominal"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """Return the nominal values."""
        return space.nominal


class _Draw(Stepper):
    """One generation: the population is a uniform draw, so that the interval is the range's."""

    def __init__(self, run: Run, rng: np.random.Generator, estimate: FloatArray) -> None:
        self._run = run
        self._coordinates = Coordinates(run.problem)
        self._unit = self._coordinates.sample(rng, max(run.budget.population, 2))
        self._estimate = estimate

    @property
    def finished(self) -> bool:
        """Whether the one generation was noted."""
        return bool(self._run.trace)

    def step(self) -> None:
        """Note the draw."""
        self._run.note("no data is read", self._coordinates.members(self._unit).theta, {})

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`."""
        middle = self._coordinates.clip_latency(0.5 * sum(self._run.problem.latency_range_s))
        return self._run.result(
            self._coordinates,
            Members(self._estimate[None], np.array([middle])),
            self._coordinates.members(self._unit),
            settings=NoSettings(),
            extra={"interval": "the range, uncalibrated"},
        )

    def save(self) -> dict[str, Any]:
        """See :meth:`Stepper.save`."""
        return {"unit": self._unit}

    def load(self, state: State) -> None:
        """See :meth:`Stepper.load`."""
        self._unit = state["unit"]


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

    def begin(self, run: Run, rng: np.random.Generator) -> Stepper:
        """See :meth:`Search.begin`."""
        return _Random(run, rng, self.settings)


class _Random(Stepper):
    """A run of `random`: one draw of a population a generation, of which the best are kept."""

    def __init__(self, run: Run, rng: np.random.Generator, settings: RandomSettings) -> None:
        self._run, self._rng, self._settings = run, rng, settings
        self._coordinates = Coordinates(run.problem)
        self._windows = cut(run.problem, settings.ticks)
        # One metric for all draws, that of the range's centre: scores of different metrics do not compare.
        self._middle = self._coordinates.members(np.full((1, self._coordinates.count), 0.5))
        self._unit = np.empty((0, self._coordinates.count))
        self._score = np.empty(0)

    @property
    def finished(self) -> bool:
        """Whether the budget's draws, or those of one generation, were made."""
        return len(self._run.trace) >= max(self._run.budget.generations, 1)

    def step(self) -> None:
        """Draw and score one population."""
        unit = self._coordinates.sample(self._rng, self._run.budget.population)
        members = self._coordinates.members(unit)
        residual = whitened_residual(self._run.problem, members, self._middle, self._windows)
        score = np.mean(np.abs(residual), axis=1)
        score = np.where(np.isfinite(score), score, np.inf)
        units, scores = np.concatenate([self._unit, unit]), np.concatenate([self._score, score])
        order = np.argsort(scores, kind="stable")[: max(self._settings.elite, 2)]
        self._unit, self._score = units[order], scores[order]
        values = {"best": float(score.min())}
        self._run.note(f"best {self._score[0]:.3g}", members.theta, values, members.latency_s)

    def result(self) -> CalibrationResult:
        """See :meth:`Stepper.result`."""
        elite = self._coordinates.members(self._unit)
        best = Members(elite.theta[:1], elite.latency_s[:1])
        return self._run.result(
            self._coordinates,
            best,
            elite,
            settings=self._settings,
            chi2=explained(self._run.problem, best, self._settings.ticks),
            extra={"interval": "spread of the best draws, uncalibrated"},
        )

    def save(self) -> dict[str, Any]:
        """See :meth:`Stepper.save`."""
        return {"unit": self._unit, "score": self._score}

    def load(self, state: State) -> None:
        """See :meth:`Stepper.load`."""
        self._unit, self._score = state["unit"], state["score"]
