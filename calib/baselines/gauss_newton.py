"""`gauss-newton`: random draws, the best refined one by one, drawn again until the residual is explained.

Many scattered starts beat one concentrated search here: a draw whose effort or speed limit is never reached
is on a plateau with a zero gradient, and only another draw leads away from it. The residual is that of `eki`:
window innovations whitened for sensor noise and start-state error, so start states are no unknowns. The
solver is that of all fits (:func:`deal_hw.calib.fit.solver.minimise`). Every start is refined to its end:
stopped at the first that seemed explained, one of six tuning seeds ended in a wrong minimum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from deal_hw.calib.data.innovations import (
    Members,
    cut,
    is_noisy,
    linearise,
    whitened_residual,
)
from deal_hw.calib.data.parts import measurements
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.search import Search, SearchLog, Stepper
from deal_hw.calib.fit.intervals import kinks_of, uncertainty
from deal_hw.calib.fit.residual import LATENCY_STEP_S, PARAMETER_STEP, Normal, value_bounds
from deal_hw.calib.fit.solver import SolverSettings, minimise
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

DRAW_SHARE = 3
"""Inverse of the largest part of a small budget's generations for draws."""

NOISY_TICKS = (5, 20)
"""Window lengths of the stages for noisy positions [control periods]."""

CLEAN_TICKS = (5, 10)
"""Window lengths of the stages for positions without noise [control periods]."""

SOLVER = SolverSettings(reach=30.0)
"""Solver of the refinement. The prior around the start is wide: insensitive parameters are drawn, not
held."""

CONVERGED = 1e-3
"""Relative gain of the residual below which no further round follows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussNewtonSettings:
    """Settings of `gauss-newton`.

    Attributes:
        draws: Parameter vectors that are scored before each multi-start.
        starts: Number of the best draws that are refined.
        survivors: Number of starts in each further stage.
        rounds: Refinements of a start in one stage, each whitened around the present point.
        restart_chi2: Chi2 above which new starts are drawn.
    """

    draws: int = 500
    starts: int = 10
    survivors: int = 4
    rounds: int = 3
    restart_chi2: float = 3.0


def members_of(problem: Problem, values: FloatArray) -> Members:
    """Return values in the parameters' own scale with the latency, (N, K + 1), in physical units."""
    return Members(problem.space.from_scale(values[:, :-1]), values[:, -1])


class Innovations:
    """Window innovations, whitened around one simulator, of parameters in their own scale and the latency.

    The parameters' priors follow as one more residual each. Windows have ``ticks`` control periods. The
    simulator to linearise around is (K + 1,). With ``follow`` it is linearised around the most probable start
    states there, not around the smoothed ones; right once the simulator is nearly right.
    """

    def __init__(self, problem: Problem, ticks: int, centre: FloatArray, *, follow: bool) -> None:
        self.problem, self.windows = problem, cut(problem, ticks)
        around = members_of(problem, centre[None])
        self._whitenings = None
        if not problem.noise_free:
            self._whitenings = [linearise(problem, around, data) for data in self.windows]
            if follow:
                self._whitenings = [
                    linearise(problem, around, data, whitening.next_offset(data.measured))
                    for data, whitening in zip(self.windows, self._whitenings, strict=True)
                ]
        steps = np.append(np.full(len(problem.space), PARAMETER_STEP), LATENCY_STEP_S)
        self._steps = steps[: len(steps) - (problem.fixed_latency_s is not None)]
        mean, std = problem.space.prior
        self._expected = np.flatnonzero(np.isfinite(std))
        self._mean, self._std = problem.space.to_scale(mean)[self._expected], std[self._expected]
        self.count = measurements(self.windows) + len(self._expected)
        """Measurements and priors."""

    def residuals(self, values: FloatArray) -> FloatArray:
        """Return the whitened residuals, (N, M), of values, (N, K + 1), in one batch."""
        members = members_of(self.problem, values)
        found = whitened_residual(self.problem, members, members, self.windows, whitenings=self._whitenings)
        off = (values[:, self._expected] - self._mean) / self._std
        return np.concatenate([found, off], axis=1)

    def residual(self, value: FloatArray) -> FloatArray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return np.asarray(self.residuals(value[None])[0])

    def jacobian(self, value: FloatArray) -> FloatArray:
        """Return forward differences, (M, K + 1); 0 for a given latency."""
        points = np.repeat(value[None], 1 + len(self._steps), axis=0)
        points[1:, : len(self._steps)] += np.diag(self._steps)
        r = self.residuals(points)
        found = np.zeros((r.shape[1], len(value)))
        # A column that diverges beside a finite base gives no direction.
        slopes = (r[1:] - r[0]) / self._steps[:, None]
        found[:, : len(self._steps)] = np.nan_to_num(slopes, posinf=0.0, neginf=0.0).T
        return found

    def split(self, residual: FloatArray) -> tuple[FloatArray, ...]:
        """Return one residual, (M,), by episodes, (W, H, channels) each, without the priors."""
        ends = np.cumsum([d.measured.size for d in self.windows])
        parts = np.split(residual[: ends[-1]], ends[:-1])
        return tuple(p.reshape(d.measured.shape) for p, d in zip(parts, self.windows, strict=True))


class _MultiStart(Stepper):
    """One run: draw, refine one start per generation, stage by stage, draw again."""

    settings: GaussNewtonSettings
    STATE = ("_stage", "_number", "_restarts", "_explained", "_drawn", "_values", "_chi2", "_best")

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        self._bounds = value_bounds(self.problem)
        self._ticks = NOISY_TICKS if is_noisy(self.problem) else CLEAN_TICKS
        self._midpoint = self._values_of(self.coordinates.midpoint)[0]
        self._restarts, self._explained = 0, False
        self._best = (math.inf, self._midpoint)
        self._begin_draws()

    def _begin_draws(self) -> None:
        # The best draws so far with their scores, later the starts with their mean squared residuals.
        self._values, self._chi2 = np.empty((0, len(self._midpoint))), np.empty(0)
        self._stage, self._number, self._drawn = -1, 0, 0

    def _values_of(self, members: Members) -> FloatArray:
        values = np.column_stack([self.problem.space.to_scale(members.theta), members.latency_s])
        low, high = self._bounds
        fixed = self.problem.fixed_latency_s
        values = np.clip(values, low, high)
        if fixed is not None:
            values[:, -1] = fixed
        return values

    @property
    def finished(self) -> bool:
        """Whether the residual is explained or the budget is used up."""
        return self._explained or len(self.log.trace) >= max(self.log.budget.generations, 1)

    def step(self) -> None:
        """Draw once more, or refine the next start."""
        if self._stage < 0:
            self._draw()
        else:
            self._refine()

    def _draw(self) -> None:
        budget, settings = self.log.budget, self.settings
        members = self.coordinates.members(self.coordinates.sample(self.rng, budget.population))
        values = self._values_of(members)
        # One metric for all draws, that of the range's midpoint. Absolute values, because squares would rank
        # most draws, which are far off, by their one worst window.
        innovations = Innovations(self.problem, self._ticks[0], self._midpoint, follow=False)
        score = np.mean(np.abs(innovations.residuals(values)), axis=1) ** 2
        pool = np.concatenate([self._values, values])
        scores = np.concatenate([self._chi2, np.where(np.isfinite(score), score, np.inf)])
        order = np.argsort(scores, kind="stable")[: settings.starts]
        self._values, self._chi2 = pool[order], scores[order]
        self._drawn += len(values)
        self._note(f"{self._drawn} draws: best {math.sqrt(self._chi2[0]):.3g}", members)
        self._keep_best()
        share = max(budget.generations // DRAW_SHARE, 1)
        if self._drawn >= min(settings.draws, share * budget.population):
            self._begin_stage(0)

    def _begin_stage(self, stage: int) -> None:
        self._stage, self._number = stage, 0
        self._chi2 = np.full(len(self._values), np.inf)

    def _refine(self) -> None:
        settings, number = self.settings, self._number
        ticks, follow = self._ticks[self._stage], self._stage > 0
        value, chi2 = self._values[number], math.inf
        fixed = self.problem.fixed_latency_s is not None
        for _ in range(settings.rounds):
            innovations = Innovations(self.problem, ticks, value, follow=follow)
            value, _ = minimise(innovations, value, self._bounds, SOLVER, fixed_latency=fixed)
            before, chi2 = chi2, float(np.sum(innovations.residual(value) ** 2)) / innovations.count
            if not chi2 < before * (1 - CONVERGED):
                break
        self._values[number], self._chi2[number] = value, chi2 if math.isfinite(chi2) else math.inf
        self._keep_best()
        self._note(
            f"windows of {ticks} ticks: start {number + 1} of {len(self._values)}, chi2 {chi2:.3g}",
            members_of(self.problem, self._values),
        )
        self._number += 1
        if self._number == len(self._values):
            self._end_stage()

    def _keep_best(self) -> None:
        # Residuals over shorter windows and scores of draws are not comparable with those of the last stage.
        at = int(np.argmin(self._chi2))
        chi2 = float(self._chi2[at]) if self._stage == len(self._ticks) - 1 else math.inf
        if chi2 <= self._best[0]:
            self._best = (chi2, self._values[at].copy())

    def _end_stage(self) -> None:
        if self._stage + 1 < len(self._ticks):
            order = np.argsort(self._chi2, kind="stable")[: self.settings.survivors]
            self._values = self._values[order]
            self._begin_stage(self._stage + 1)
        elif np.min(self._chi2) <= self.settings.restart_chi2:
            self._explained = True
        else:
            self._restarts += 1
            self._begin_draws()

    def _note(self, message: str, members: Members) -> None:
        values = {"stage": float(self._stage), "chi2": float(np.min(self._chi2))}
        self.log.note(message, members, values)

    def result(self) -> CalibrationResult:
        """Return the best start, with intervals from the normal equations there."""
        problem, value = self.problem, self._best[1]
        innovations = Innovations(problem, self._ticks[-1], value, follow=True)
        residual, jacobian = np.nan_to_num(innovations.residual(value)), innovations.jacobian(value)
        cost, nothing = float(np.sum(residual**2)), np.zeros(len(value))
        chi2 = cost / innovations.count
        split = innovations.split(residual)
        known = uncertainty(
            problem.space,
            problem.space.from_scale(value[:-1]),
            self.coordinates.clip_latency(float(value[-1])),
            Normal(cost, innovations.count, jacobian.T @ jacobian, nothing, split, nothing),
            chi2,
            problem.latency_range_s,
            fixed_latency=problem.fixed_latency_s is not None,
            timing_std_s=problem.noise.timing_std_s,
            kinks=kinks_of(problem),
        )
        return self.log.result(
            members_of(problem, value[None]),
            members_of(problem, self._values if len(self._values) else value[None]),
            chi2=chi2,
            alarms=known.alarms,
            extra={"restarts": self._restarts, "interval": "90 %, from the normal equations"},
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=known.null_directions,
            prior_directions=known.prior_directions,
            latency_interval_s=known.latency_interval_s,
        )


@dataclass(frozen=True)
class GaussNewton(Search):
    """Multi-start least squares on whitened window innovations."""

    name = "gauss-newton"
    stepper = _MultiStart
    settings: GaussNewtonSettings = field(default_factory=GaussNewtonSettings)
