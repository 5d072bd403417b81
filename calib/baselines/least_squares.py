"""`least-squares`: one-step prediction error from recorded states, minimised from one start.

And `least-squares-multistart`, a stronger one for real recordings: windows, a latency, several starts.

The first is the plain textbook baseline of the paper's Table 6. Every control period starts from the reported
state, and the simulation predicts the next one. `scipy.optimize.least_squares` (trust region, with the ranges
as bounds) minimises the sum of squared differences. It starts at the midpoint of the ranges, or as
`least-squares-random` at a random point of the linear ranges: the paper found it sensitive to the start. Each
recorded quantity is divided by its change in one control period; there are no other weights. There is no
noise model, no latency unless given, and no second start: errors in the recorded states go into the
parameters, and a start on a plateau stays there. Parameters are in their own scale (log for positive ones).
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from deal_hw.calib.data.independent import in_order
from deal_hw.calib.data.innovations import Members, explained, samples_per_tick
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.data.resume import State
from deal_hw.calib.data.search import Search, SearchLog, Stepper
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.intervals import intervals
from deal_hw.calib.fit.output_error import OutputErrorFit, Recipe, fit_output_error
from deal_hw.calib.fit.residual import PARAMETER_STEP
from deal_hw.calibration import CalibrationResult
from deal_hw.errors import InsufficientDataError
from deal_hw.findings import Finding
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.parts import spread, stretches
from deal_hw.types import FloatArray

TOLERANCE = 1e-8
"""Relative change of cost and parameters at which the search ends."""

DIVERGED = 1e3
"""Residual of a diverged simulation [typical changes]: scipy takes no infinities."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeastSquaresSettings:
    """Settings of `least-squares`.

    Attributes:
        random_start: Whether it starts from a random point, uniform in the linear range.
    """

    random_start: bool = False


@dataclass(frozen=True, slots=True)
class FittedStart:
    """Result of a one-shot optimiser.

    Attributes:
        theta: Physical values, (K,).
        covariance: In each parameter's own scale, (K, K).
        latency_s: The assumed latency [s].
        iterations: Iterations of the optimiser.
        message: Why it stopped.
        source: Source of the intervals, in words.
        steps: Physics steps outside the problem's own simulator.
        alarms: Reasons to distrust it.
        interval: The optimiser's own 90 % intervals, (K, 2); None: from the covariance.
    """

    theta: FloatArray
    covariance: FloatArray
    latency_s: float
    iterations: int
    message: str
    source: str
    steps: int = 0
    alarms: tuple[Finding, ...] = ()
    interval: FloatArray | None = None


class OneShot(Stepper):
    """A run of an optimiser that cannot be interrupted: one generation."""

    EXPLAINED_TICKS = 10
    """Window length of the stated residual, in control periods."""

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: OneShotSearch) -> None:
        super().__init__(log, rng, search)
        self._solve = search.solve
        self._found: FittedStart | None = None

    @property
    def finished(self) -> bool:
        """Whether the optimiser has run."""
        return self._found is not None

    def step(self) -> None:
        """Run the optimiser to its end."""
        self._found = found = self._solve(self.log, self.rng)
        words = f"{found.iterations} iterations: {found.message}"
        self.log.note(words, self._members(found), {"iterations": float(found.iterations)})

    def _members(self, found: FittedStart) -> Members:
        return Members(found.theta[None], np.array([self.coordinates.clip_latency(found.latency_s)]))

    def result(self) -> CalibrationResult:
        """Return the optimiser's result."""
        found = self._found
        if found is None:
            raise InsufficientDataError("the optimiser has not run yet; call step() first")
        interval = found.interval
        if interval is None:
            interval = intervals(self.problem.space, found.theta, found.covariance)
        centre = self._members(found)
        chi2 = explained(self.problem, centre, self.EXPLAINED_TICKS)
        return self.log.result(
            centre,
            centre,
            chi2=chi2,
            alarms=found.alarms,
            extra={
                "interval": found.source,
                "iterations": found.iterations,
                "stopped": found.message,
                "assumed_latency_s": found.latency_s,
            },
            interval=interval,
            covariance=found.covariance,
            steps=self.log.steps + found.steps,
        )

    def save(self) -> State:
        """Return the result, if there is one."""
        return {"found": None if self._found is None else dataclasses.asdict(self._found)}

    def load(self, state: State) -> None:
        """Continue from a saved state."""
        saved = state["found"]
        if saved is not None:
            alarms = (Finding.alarm(a["seen"], a["means"], a["do"]) for a in saved["alarms"])
            self._found = FittedStart(**{**saved, "alarms": tuple(alarms)})


class OneShotSearch(Search, abc.ABC):
    """A search by an optimiser that is one call, so a run is one generation.

    An interrupted run begins again, with the same result. The budget's generations limit the iterations.
    """

    stepper = OneShot

    @abc.abstractmethod
    def solve(self, log: SearchLog, rng: np.random.Generator) -> FittedStart:
        """Run the optimiser to its end."""


@dataclass(frozen=True)
class LeastSquaresBaseline(OneShotSearch):
    """Single-start least squares on the one-step prediction error."""

    settings: LeastSquaresSettings = field(default_factory=LeastSquaresSettings)
    name: str = "least-squares"

    def solve(self, log: SearchLog, rng: np.random.Generator) -> FittedStart:
        """See :meth:`OneShotSearch.solve`."""
        problem, space, settings = log.problem, log.problem.space, self.settings
        latency_s = log.coordinates.clip_latency(0.0)
        start = rng.uniform(space.low, space.high) if settings.random_start else space.center
        error = OneStep(problem, latency_s, DIVERGED)
        ends: dict[str, Any] = dict.fromkeys(("ftol", "xtol", "gtol"), TOLERANCE)
        ends["max_nfev"] = max(log.budget.generations, 1)
        solution = _minimise(error, 0.0, space.to_scale(start), ends)
        count = len(solution.fun)
        if np.isfinite(space.prior[1]).any():
            # Without a noise model, a prior's standard deviation is weighted by the residuals' own spread.
            spread = float(np.sqrt(solution.fun @ solution.fun / max(count - len(space), 1)))
            solution = _minimise(error, max(spread, np.finfo(float).tiny), solution.x, ends)
        return FittedStart(
            theta=np.clip(space.from_scale(solution.x), space.low, space.high),
            covariance=textbook_covariance(space, np.asarray(solution.jac)[:count], solution.fun[:count]),
            latency_s=latency_s,
            iterations=int(solution.nfev),
            message=str(solution.message),
            source=f"textbook s^2 inv(J'J), latency {latency_s:g} s",
            alarms=() if solution.status else (_unfinished(int(solution.nfev)),),
        )


def from_random_start() -> LeastSquaresBaseline:
    """Return `least-squares-random`: `least-squares` from a random point of the range."""
    return LeastSquaresBaseline(LeastSquaresSettings(random_start=True), name="least-squares-random")


def textbook_covariance(space: ParameterSpace, jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Return s^2 inv(J'J), (K, K), from derivatives (R, K) in each parameter's own scale, and residuals (R,).

    The range is a flat prior, which keeps insensitive parameters finite. A parameter's own prior is added.
    """
    variance = float(residual @ residual) / max(len(residual) - len(space), 1)
    information = jacobian.T @ jacobian / max(variance, np.finfo(float).tiny)
    prior = 12.0 / space.width**2 + 1.0 / space.prior[1] ** 2
    return np.asarray(np.linalg.inv(information + np.diag(prior)), dtype=np.float64)


def _minimise(error: OneStep, weight: float, start: FloatArray, ends: Mapping[str, Any]) -> Any:
    """Run scipy's trust region on the one-step error and, times a weight, on the parameters' priors."""
    space = error.space
    mean, std = space.prior
    expected = np.isfinite(std) & (weight > 0)
    step = PARAMETER_STEP * np.eye(len(space))

    def rows(values: FloatArray) -> FloatArray:
        found = error.residual(values)
        off = ((values - space.to_scale(mean)) / std)[:, expected]
        return np.concatenate([found, weight * off], axis=1) if expected.any() else found

    def residual(value: FloatArray) -> FloatArray:
        return np.asarray(rows(value[None])[0], dtype=np.float64)

    def jacobian(value: FloatArray) -> FloatArray:
        r = rows(np.concatenate([value[None], value + step]))
        return np.asarray((r[1:] - r[0]).T / PARAMETER_STEP)

    bounds = space.to_scale(space.low), space.to_scale(space.high)
    return least_squares(residual, start, jac=jacobian, bounds=bounds, **ends)


class OneStep:
    """Differences between each recorded state and its prediction from one control period before."""

    def __init__(self, problem: Problem, latency_s: float, diverged: float = 1e3) -> None:
        self._problem, self._latency_s, self._diverged = problem, latency_s, diverged
        self.space = problem.space
        self._data = problem.windows(samples_per_tick(problem))
        self._recorded = [self._states(d) for d in self._data]
        first = problem.episodes[self._data[0].episode]
        # If all positions were measured, velocities were recorded too; otherwise only measured ones count.
        counts = np.ones(2 * problem.coordinates, dtype=bool)
        if first.measured is not None:
            counts = first.measured.copy()
        counts &= np.all([np.isfinite(r).all(axis=(0, 1)) for r in self._recorded], axis=0)
        change = np.concatenate([r[1] - r[0] for r in self._recorded])
        scale = np.sqrt(np.mean(change**2, axis=0))
        counts &= scale > 0
        if not counts.any():
            raise InsufficientDataError("no recorded quantity ever changes; move the robot")
        self._counts, self._scale = counts, scale[counts]

    def _states(self, data: WindowData) -> FloatArray:
        """Return recorded (position, velocity) at the start and the end of each window, (2, W, 2 C)."""
        episode = self._problem.episodes[data.episode]
        whole = np.concatenate([episode.position, episode.velocity], axis=1)
        return np.stack([whole[data.windows.start], whole[data.windows.samples()[:, -1]]])

    def residual(self, values: FloatArray) -> FloatArray:
        """Return the scaled differences of parameters in their own scale, (N, K): (N, R)."""
        problem = self._problem
        theta, latency = problem.space.from_scale(values), np.full(len(values), self._latency_s)
        parts = []
        for data, recorded in zip(self._data, self._recorded, strict=True):
            smoothed = np.concatenate([data.start_position, data.start_velocity], axis=1)
            start = np.where(np.isfinite(recorded[0]), recorded[0], smoothed)
            C = problem.coordinates
            predicted = problem.predict(theta, latency, data, start[:, :C], start[:, C:])
            ahead = np.concatenate([predicted.position[:, :, -1], predicted.velocity[:, :, -1]], axis=-1)
            difference = (ahead - recorded[1])[..., self._counts] / self._scale
            parts.append(difference.reshape(len(values), -1))
        whole, far = np.concatenate(parts, axis=1), self._diverged
        return np.asarray(np.nan_to_num(whole, nan=far, posinf=far, neginf=-far))


WINDOW_S = 0.4
"""Length of the windows [s]."""

FIRST_S = 12.0
"""Length of data of the first fits, evenly spread [s]."""

PART_S = 2.5
"""Length of the parts into which the recordings are cut for the first fits [s]."""

FIRST_ITERATIONS = 8
"""Iterations of each first fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MultiStartSettings:
    """Settings of `least-squares-multistart`.

    Attributes:
        starts: Number of starts: the nominal values, and draws over all ranges.
        survivors: Number of the best starts that continue with all recordings.
    """

    starts: int = 8
    survivors: int = 2


@dataclass(frozen=True)
class MultiStartLeastSquares(OneShotSearch):
    """Least squares on predictions from smoothed states, the best of several starts.

    It is what a careful user writes: Levenberg-Marquardt on the position error in windows of some tenths of a
    second. Each channel is divided by its own root mean square residual, and the latency is one more unknown.
    The ranges are bounds; there is no other prior.
    """

    name = "least-squares-multistart"
    settings: MultiStartSettings = field(default_factory=MultiStartSettings)

    def solve(self, log: SearchLog, rng: np.random.Generator) -> FittedStart:
        """See :meth:`OneShotSearch.solve`."""
        problem, settings = log.problem, self.settings
        drawn = log.coordinates.members(log.coordinates.sample(rng, settings.starts - 1))
        nominal = problem.space.nominal, log.coordinates.clip_latency(0.0)
        starts = [nominal, *zip(drawn.theta, map(float, drawn.latency_s), strict=True)]
        recipe = Recipe(seconds=WINDOW_S, prior_std=np.inf)
        parts = [p for e in problem.episodes for p in stretches(e, PART_S)]
        part = dataclasses.replace(problem, episodes=spread(parts, FIRST_S))
        few, most = FIRST_ITERATIONS, max(log.budget.generations, 1)
        rough = list(in_order(part, partial(_rough, recipe=recipe, iterations=few), starts))
        order = np.argsort([fit.score for fit in rough], kind="stable")[: settings.survivors]
        good = [rough[i].member for i in order]
        fits = [fit_output_error(problem, theta, late, recipe, iterations=most) for theta, late in good]
        best = min(fits, key=_score)
        K = len(problem.space)
        residual = np.concatenate([r.ravel() for r in best.normal.residual])
        variance = float(residual @ residual) / max(len(residual) - K, 1)
        # The range as a flat prior keeps insensitive parameters finite.
        flat = np.diag(12.0 / problem.space.width**2)
        return FittedStart(
            theta=best.theta,
            covariance=np.asarray(np.linalg.inv(best.normal.hessian[:K, :K] / variance + flat)),
            latency_s=best.latency_s,
            iterations=sum(fit.iterations for fit in rough) + sum(fit.iterations for fit in fits),
            message=f"best of {len(starts)} starts, {len(fits)} of them fitted to all recordings",
            source=f"textbook s^2 inv(J'J), best of {settings.starts} starts",
            steps=part.steps,
            alarms=() if best.iterations < most else (_unfinished(most),),
        )


class _Rough(NamedTuple):
    """A first fit: what comes back from a worker.

    Attributes:
        member: Its parameters, (K,), and latency [s].
        score: Its residual; lower is better.
        iterations: Iterations used.
    """

    member: Member
    score: float
    iterations: int


def _rough(problem: Problem, start: Member, recipe: Recipe, iterations: int) -> _Rough:
    fit = fit_output_error(problem, start[0], start[1], recipe, iterations=iterations)
    return _Rough(fit.member, _score(fit), fit.iterations)


def _unfinished(iterations: int) -> Finding:
    return Finding.alarm(
        f"The fit had not converged after {iterations} iterations.",
        "Its values may still be far from those that fit best.",
        "Allow more (--generations).",
    )


def _score(fit: OutputErrorFit) -> float:
    score = float(np.mean(np.log(fit.scale)))
    return score if np.isfinite(score) else np.inf
