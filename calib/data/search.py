"""Searches by generations, which can be watched, stopped, saved and resumed exactly.

A method is two classes. The :class:`Search` holds settings and makes a :class:`Stepper` for each run. The
stepper holds everything that changes. Its saved state between two generations, together with the generator's,
decides all that follows.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Stateful, restore_generator
from deal_hw.calibration import (
    Z90,
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)
from deal_hw.findings import Finding
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoSettings:
    """Settings of a method that has none."""


class Coordinates:
    """The map between a unit cube of K parameters (and the latency) and physical values.

    Parameters are uniform in their own scale, log for positive ones; the latency is linear.

    Args:
        problem: Gives the space and the latency or its range.
        margin_s: Extension of the latency's range [s], without which a latency of zero would be at infinity.
            It is less than :func:`~deal_hw.calib.data.innovations.early_setpoints` can undo.
        linear: Parameters are uniform in their value, whatever their scale.
        latency: Search the latency if it is not given; otherwise it is zero.
    """

    def __init__(
        self, problem: Problem, margin_s: float = 0.004, *, linear: bool = False, latency: bool = True
    ) -> None:
        self.space, self._linear = problem.space, linear
        self.fixed_latency_s = problem.fixed_latency_s
        if self.fixed_latency_s is None and not latency:
            self.fixed_latency_s = 0.0
        self._range = problem.latency_range_s
        self._low = self._range[0] - margin_s
        self._width = self._range[1] - self._range[0] + 2 * margin_s

    @property
    def count(self) -> int:
        """Number of coordinates: K, plus one if the latency is searched."""
        return len(self.space) + (self.fixed_latency_s is None)

    def members(self, unit: FloatArray) -> Members:
        """Map unit coordinates, (N, C), to physical values; parameters are clipped to their range."""
        K, space = len(self.space), self.space
        part = unit[:, :K]
        theta = space.low + (space.high - space.low) * part if self._linear else space.unnormalize(part)
        theta = np.clip(theta, space.low, space.high)
        if self.fixed_latency_s is not None:
            return Members(theta, np.full(len(unit), self.fixed_latency_s))
        latency = self._low + self._width * np.clip(unit[:, K], 0.0, 1.0)
        return Members(theta, latency)

    @property
    def midpoint(self) -> Members:
        """The one member in the middle of every range."""
        return self.members(np.full((1, self.count), 0.5))

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw unit coordinates, (count, C), over all ranges; the latency without its margin."""
        unit = rng.random((count, self.count))
        if self.fixed_latency_s is None:
            inner = self._range[0] + (self._range[1] - self._range[0]) * unit[:, -1]
            unit[:, -1] = (inner - self._low) / self._width
        return unit

    def clip_latency(self, latency_s: float) -> float:
        """Return the latency clipped to the requested range [s]."""
        if self.fixed_latency_s is not None:
            return self.fixed_latency_s
        return float(np.clip(latency_s, *self._range))


class SearchLog:
    """Trace, counts and result of one search."""

    def __init__(
        self,
        method: str,
        problem: Problem,
        budget: Budget,
        progress: ProgressCallback | None,
        settings: Any,
        coordinates: Coordinates,
    ) -> None:
        self.method, self.problem, self.budget, self._settings = method, problem, budget, settings
        self.coordinates = coordinates
        self.trace: list[dict[str, float]] = []
        self._progress = progress
        self._steps = problem.steps
        self._start = time.perf_counter()
        self._earlier_steps, self._earlier_seconds = 0, 0.0

    def note(self, message: str, members: Members, values: Mapping[str, float]) -> None:
        """Append one generation to the trace and call the callback, which may raise to stop the run."""
        self.trace.append({"generation": float(len(self.trace)), **values})
        if self._progress is not None:
            total = max(self.budget.generations, len(self.trace))
            latency_s = float(np.mean(members.latency_s))
            progress = Progress("search", len(self.trace), total, message, members.theta, latency_s, values)
            self._progress(progress)

    @property
    def steps(self) -> int:
        """Physics steps so far, including those before a resume."""
        return self._earlier_steps + self.problem.steps - self._steps

    @property
    def seconds(self) -> float:
        """Wall clock so far, including that before a resume [s]."""
        return self._earlier_seconds + time.perf_counter() - self._start

    def save(self) -> dict[str, Any]:
        """Return the state as plain values."""
        return {"trace": self.trace, "steps": self.steps, "seconds": self.seconds}

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
        self.trace[:] = state["trace"]
        self._earlier_steps, self._earlier_seconds = state["steps"], state["seconds"]
        self._steps, self._start = self.problem.steps, time.perf_counter()

    def unexplained(self, chi2: float) -> Finding:
        """Return the alarm of a search that left a residual."""
        return Finding.alarm(
            f"After {len(self.trace)} generations the residual is {chi2:.1f} times its expected variance.",
            "The search ended far from the robot's values, or the model is incomplete.",
            "Refine it, search again (another --seed, more --generations, wider ranges), or check the model.",
        )

    def critic_diverged(self, times: int) -> list[Finding]:
        """Return the alarm of a critic whose training was undone so many times; none for 0."""
        if not times:
            return []
        seen = f"The critic's training diverged in {times} of {len(self.trace)} generations."
        means = "Its last sound weights were used there, and they tell less about the simulators."
        do = "Search again with another --seed, or with --search eki, which has no critic."
        return [Finding.alarm(seen, means, do)]

    def result(
        self,
        centre: Members,
        population: Members,
        *,
        chi2: float = float("nan"),
        alarms: Sequence[Finding] = (),
        extra: Mapping[str, Any] | None = None,
        **better: Any,
    ) -> CalibrationResult:
        """Return the result; ``better`` are fields for which the method has better values.

        The interval is the 5-95 % range of a normal distribution with the population's spread. It is NOT
        calibrated: a population shrinks by the searcher's step rule, too far for small ensembles, and to
        nothing for diffusion evolution. The refinement computes intervals from the data.
        """
        space = self.problem.space
        scaled = space.to_scale(population.theta)
        covariance = np.atleast_2d(np.cov(scaled, rowvar=False)) if len(scaled) > 1 else None
        std = np.zeros(len(space)) if covariance is None else np.sqrt(np.diag(covariance))
        middle = space.to_scale(centre.theta[0])
        interval = np.stack(
            [space.from_scale(middle - Z90 * std), space.from_scale(middle + Z90 * std)], axis=1
        )
        clip = self.coordinates.clip_latency
        latency = clip(float(centre.latency_s[0]))
        spread = float(population.latency_s.std(ddof=1)) if len(scaled) > 1 else 0.0
        plain = CalibrationResult(
            method=self.method,
            space=space,
            estimate=np.array(centre.theta[0]),
            interval=np.clip(interval, space.low[:, None], space.high[:, None]),
            covariance=covariance,
            population=population.theta,
            latency_s=latency,
            latency_interval_s=(clip(latency - Z90 * spread), clip(latency + Z90 * spread)),
            chi2=chi2,
            alarms=tuple(alarms),
            trace=tuple(self.trace),
            steps=self.steps,
            seconds=self.seconds,
            provenance={"settings": asdict(self._settings), "budget": asdict(self.budget), **(extra or {})},
        )
        return replace(plain, **better)


class Stepper(Stateful, abc.ABC):
    """One run of a search, between its generations."""

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        self.log, self.rng = log, rng
        self.problem, self.coordinates = log.problem, log.coordinates
        self.settings: Any = search.settings

    @property
    @abc.abstractmethod
    def finished(self) -> bool:
        """Whether nothing is left to do."""

    @abc.abstractmethod
    def step(self) -> None:
        """Do one generation and call ``SearchLog.note`` once."""

    @abc.abstractmethod
    def result(self) -> CalibrationResult:
        """Return the result so far."""


class Search(CalibrationMethod[Problem]):
    """A calibration method whose run is a sequence of generations; ``settings`` is a dataclass."""

    settings: Any
    stepper: ClassVar[type[Stepper]]
    """Makes a run before its first generation."""

    def coordinates(self, problem: Problem) -> Coordinates:
        """Return the coordinates in which this method searches."""
        return Coordinates(problem)

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Search to the end; see :meth:`deal_hw.calibration.CalibrationMethod.run`."""
        log = SearchLog(self.name, problem, budget, progress, self.settings, self.coordinates(problem))
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


class RangedSearch(Search):
    """A search with the settings ``linear`` and ``latency`` of :class:`Coordinates`."""

    def coordinates(self, problem: Problem) -> Coordinates:
        """Return the coordinates in which this method searches."""
        return Coordinates(problem, linear=self.settings.linear, latency=self.settings.latency)
