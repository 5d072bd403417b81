"""A search that goes generation by generation, so that it can be watched, stopped, saved and resumed exactly.

A method is two classes: the :class:`Search`, which holds settings and makes for each run a :class:`Stepper`,
which holds everything that changes. What a stepper saves between two generations, with the generator's state,
decides all that follows.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.search.log import SearchLog
from deal_hw.calib.search.resume import Kept, restore_generator
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback, StateStore


class Stepper(Kept, abc.ABC):
    """One run of a search, between its generations.

    Args:
        log: Book-keeping of the run.
        rng: The only source of randomness.
        search: The method.
    """

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        self.log, self.rng = log, rng
        self.problem, self.coordinates = log.problem, log.coordinates
        self.settings: Any = search.settings

    @property
    @abc.abstractmethod
    def finished(self) -> bool:
        """Whether there is nothing left to do."""

    @abc.abstractmethod
    def step(self) -> None:
        """Do one generation and note it (``SearchLog.note``), which is once for each call."""

    @abc.abstractmethod
    def result(self) -> CalibrationResult:
        """Return what was found so far."""


class Search(CalibrationMethod[Problem]):
    """A calibration method whose run is a sequence of generations.

    Attributes:
        settings: How to run, a dataclass.
    """

    settings: Any
    stepper: ClassVar[type[Stepper]]
    """Makes a run before its first generation; its arguments are those of :class:`Stepper`."""

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Search to the end; see :meth:`deal_hw.calibration.CalibrationMethod.run`."""
        log = SearchLog(self.name, problem, budget, progress, self.settings)
        stepper = self.stepper(log, rng, self)
        saved = checkpoint.load() if checkpoint is not None else None
        if saved is not None:
            log.load(saved["log"])
            stepper.load(saved["search"])
            # Last: making and loading the stepper may have drawn from it.
            restore_generator(rng, saved["generator"])
        while not stepper.finished:
            stepper.step()
            if checkpoint is not None:
                state = {"log": log.save(), "search": stepper.save(), "generator": rng.bit_generator.state}
                checkpoint.save(state)
        return stepper.result()
