"""No-data baselines, which ignore the recording; `nominal` also stands in for a search where none is wanted.

`midpoint` and `nominal` are in every table: a method that does not beat them has learned nothing from the
data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.search import NoSettings, Search, SearchLog, Stepper
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray


class _Draw(Stepper):
    """One generation: the population is a uniform draw, so that the interval is the range's."""

    STATE = ("_unit",)

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: NoData) -> None:
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


@dataclass(frozen=True)
class NoData(Search):
    """A method that reads no data; its interval is the whole range."""

    name: str
    stepper = _Draw
    settings = NoSettings()

    @property
    def moves(self) -> bool:
        """Whether it returns other values than the model's own."""
        return self.name != "nominal"

    def estimate(self, space: ParameterSpace) -> FloatArray:
        """Return the estimate, (K,)."""
        if self.name == "midpoint-linear":
            return np.asarray((space.low + space.high) / 2)
        return space.center if self.name == "midpoint" else space.nominal


def midpoint() -> NoData:
    """Return `midpoint`: the middle of every range, in the range's own scale."""
    return NoData("midpoint")


def linear_midpoint() -> NoData:
    """Return `midpoint-linear`: the middle of every range on a linear scale."""
    return NoData("midpoint-linear")


def nominal() -> NoData:
    """Return `nominal`: the values of the user's own model."""
    return NoData("nominal")
