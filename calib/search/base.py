"""A search that goes generation by generation, so that it can be watched, stopped, saved and resumed exactly.

A method is two classes: the :class:`Search`, which holds settings and makes for each run a :class:`Stepper`,
which holds everything that changes. What a stepper saves between two generations, with the generator's state,
decides all that follows.
"""

from __future__ import annotations

import abc
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.search.checkpoint import State, generator_state, restore_generator
from deal_hw.calib.search.log import Run
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback, StateStore


class Stepper(abc.ABC):
    """One run of a search, between its generations."""

    @property
    @abc.abstractmethod
    def finished(self) -> bool:
        """Whether there is nothing left to do."""

    @abc.abstractmethod
    def step(self) -> None:
        """Do one generation and note it (``Run.note``), which is once for each call."""

    @abc.abstractmethod
    def result(self) -> CalibrationResult:
        """Return what was found so far."""

    @abc.abstractmethod
    def save(self) -> State:
        """Return everything that later generations depend on, but for the generator and the trace."""

    @abc.abstractmethod
    def load(self, state: State) -> None:
        """Continue from a saved state."""


class Search(CalibrationMethod[Problem]):
    """A calibration method whose run is a sequence of generations."""

    @abc.abstractmethod
    def begin(self, run: Run, rng: np.random.Generator) -> Stepper:
        """Return the run before its first generation."""

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Search to the end; see :meth:`deal_hw.calibration.CalibrationMethod.run`."""
        run = Run(self.name, problem, budget, progress)
        stepper = self.begin(run, rng)
        saved = checkpoint.load() if checkpoint is not None else None
        if saved is not None:
            run.load(saved["run"])
            stepper.load(saved["search"])
            # Last: making and loading the stepper may have drawn from it.
            restore_generator(rng, saved["generator"])
        while not stepper.finished:
            stepper.step()
            if checkpoint is not None:
                checkpoint.save(_whole(run, stepper, rng))
        return stepper.result()


def _whole(run: Run, stepper: Stepper, rng: np.random.Generator) -> dict[str, Any]:
    return {"run": run.save(), "search": stepper.save(), "generator": generator_state(rng)}
