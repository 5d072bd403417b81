"""The searches of one calibration: those that are over, and the one that runs, kept to be resumed."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.search.checkpoint import generator_state, restore_generator
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback, StateStore


class Attempts:
    """Runs a search again and again; what an interrupted run had finished is not run a second time.

    It is the running search's store: what that search keeps goes into the whole run's store with the rest.

    Args:
        search: The search.
        rng: The only source of randomness.
        store: Where the whole run is kept; None to keep nothing.
    """

    def __init__(
        self,
        search: CalibrationMethod[Problem],
        rng: np.random.Generator,
        store: StateStore | None,
    ) -> None:
        self._search, self._rng, self._store = search, rng, store
        self.finished: list[CalibrationResult] = []
        self.earlier_steps = 0
        """Physics steps that the searches simulated before this process resumed them."""
        self.earlier_seconds = 0.0
        """Wall clock that they took before this process resumed them [s]."""
        self._kept: list[Mapping[str, Any]] = []
        self._running: Mapping[str, Any] | None = None
        saved = store.load() if store is not None else None
        if saved is not None:
            self._kept = list(saved["finished"])
            self.finished = [restored_result(state) for state in self._kept]
            self._running = saved["running"]
            restore_generator(rng, saved["generator"])
            for result in self.finished:
                self._count(result, 0, 0.0)
        self._generator = generator_state(rng)

    def run(
        self, problem: Problem, number: int, budget: Budget, progress: ProgressCallback | None
    ) -> CalibrationResult:
        """Return the result of attempt ``number``, 0 for the first.

        Args:
            problem: Data and simulator.
            number: Which attempt; at most one more than are finished.
            budget: What that search may use.
            progress: Called after each of its generations.
        """
        if number < len(self.finished):
            return dataclasses.replace(self.finished[number], space=problem.space)
        steps, began = problem.steps, time.perf_counter()
        if self._store is None:
            result = self._search.run(problem, budget, self._rng, progress)
        else:
            result = self._search.run(problem, budget, self._rng, progress, self)
        self._count(result, problem.steps - steps, time.perf_counter() - began)
        self.finished.append(result)
        if self._store is not None:
            self._kept.append(kept_result(result))
            self._running, self._generator = None, generator_state(self._rng)
            self._write(self._store)
        return result

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep the running search's state; see :class:`deal_hw.calibration.StateStore`."""
        self._running = state
        if self._store is not None:
            self._write(self._store)

    def load(self) -> Mapping[str, Any] | None:
        """Return the running search's state, or None where it has not begun."""
        return self._running

    def _count(self, result: CalibrationResult, steps_here: int, seconds_here: float) -> None:
        self.earlier_steps += result.steps - steps_here
        self.earlier_seconds += max(result.seconds - seconds_here, 0.0)

    def _write(self, store: StateStore) -> None:
        store.save({"finished": self._kept, "generator": self._generator, "running": self._running})


def kept_result(result: CalibrationResult) -> dict[str, Any]:
    """Return a result as plain values and arrays, with the population and trace that its JSON leaves out."""
    return {
        "result": result.to_json(),
        "population": result.population,
        "trace": [dict(row) for row in result.trace],
    }


def restored_result(state: Mapping[str, Any]) -> CalibrationResult:
    """Undo :func:`kept_result`."""
    return dataclasses.replace(
        CalibrationResult.from_json(state["result"]),
        population=state["population"],
        trace=tuple(state["trace"]),
    )
