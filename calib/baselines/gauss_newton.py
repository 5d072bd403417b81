"""`gauss-newton`: random draws, the best refined side by side, drawn again until the residual is explained.

Many scattered starts beat one concentrated search here: a draw whose effort or speed limit is never reached
sits on a plateau with a zero gradient, and only another draw leads away from it. The residual is that of
`eki`, window innovations whitened for sensor noise and start-state error, so start states need no unknowns
of their own; one batch of simulations holds all starts with all their finite differences.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.innovations import Members, cut, is_noisy, whitened_residual
from deal_hw.calib.data.problem import Problem, WindowData
from deal_hw.calib.fit.residual import DIFFERENCES, Normal, value_bounds
from deal_hw.calib.search.base import Search, SearchLog, Stepper
from deal_hw.calib.search.resume import State
from deal_hw.calib.uncertainty.intervals import uncertainty
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussNewtonSettings:
    """Settings of `gauss-newton`.

    Attributes:
        draws: Parameter vectors that are scored before each multi-start.
        draw_share: Drawing takes at most one part in so many of a small budget's generations.
        starts: The best of them that are refined.
        survivors: Starts that go on to each further stage.
        noisy_ticks: Window lengths of the stages in control periods, where positions carry noise.
        clean_ticks: The same where they carry none.
        stage_generations: Most iterations of one stage.
        dampings: Each start tries a step with each of them: with ten starts each costs ten simulations of the
            recording.
        converged: Relative gain of a start's cost below which it is at rest.
        restart_chi2: A residual above this is not explained: draw again.
    """

    draws: int = 500
    draw_share: int = 3
    starts: int = 10
    survivors: int = 4
    noisy_ticks: tuple[int, ...] = (5, 20)
    clean_ticks: tuple[int, ...] = (5, 10)
    stage_generations: int = 12
    dampings: tuple[float, ...] = (1e-5, 1e-3, 1e-1, 1e1, 1e3)
    converged: float = 1e-3
    restart_chi2: float = 3.0


@dataclass(frozen=True, slots=True)
class Linear:
    """Residuals of several starts and their derivatives, all in one metric.

    Attributes:
        residual: Whitened residuals, (S, M).
        cost: Their sums of squares, (S,); infinite where a start diverged.
        gradient: Half the costs' gradients, (S, K + 1); 0 for a latency that is given.
        hessian: Half their Gauss-Newton Hessians, (S, K + 1, K + 1).
    """

    residual: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class Innovations:
    """Whitened window innovations as functions of parameters in their own scale and of the latency.

    What is expected of parameters (their priors) stands behind them as one more residual each.

    Args:
        problem: Data and simulator.
        ticks: Window length in control periods.
        follow: Linearise around the start states that were most probable in the last iteration, not around
            the smoothed ones; right once the simulator is nearly right.
    """

    def __init__(self, problem: Problem, ticks: int, follow: bool) -> None:
        self.problem = problem
        self.windows: list[WindowData] = cut(problem, ticks)
        self.offsets: list[FloatArray] | None = None
        if follow:
            self.offsets = [np.zeros((len(d.windows), 2 * d.start_position.shape[1])) for d in self.windows]
        K = len(problem.space)
        steps = np.append(np.full(K, DIFFERENCES.parameter), DIFFERENCES.latency_s)
        self._steps = steps[: K + (problem.fixed_latency_s is None)]
        mean, std = problem.space.prior
        self._expected = np.flatnonzero(np.isfinite(std))
        self._mean, self._std = problem.space.to_scale(mean)[self._expected], std[self._expected]

    def members(self, values: FloatArray) -> Members:
        """Return values, (N, K + 1), in physical units."""
        return Members(self.problem.space.from_scale(values[:, :-1]), values[:, -1])

    def residual(self, values: FloatArray, centre: FloatArray) -> FloatArray:
        """Return whitened residuals of values, (N, K + 1), in the metric of one of them, (K + 1,): (N, M)."""
        offsets = None if self.offsets is None else list(self.offsets)
        members, around = self.members(values), self.members(centre[None])
        found = whitened_residual(self.problem, members, around, self.windows, offsets)
        if not len(self._expected):
            return found
        return np.concatenate([found, (values[:, self._expected] - self._mean) / self._std], axis=1)

    def follow(self, centre: FloatArray) -> None:
        """Move the start states to the most probable ones under a simulator, (K + 1,)."""
        if self.offsets is not None:
            around = self.members(centre[None])
            whitened_residual(self.problem, around, around, self.windows, self.offsets)

    def linear(self, values: FloatArray, centre: FloatArray) -> Linear:
        """Return residuals and forward differences at several values, (S, K + 1), in one batch.

        Args:
            values: Where.
            centre: Whose metric, (K + 1,).
        """
        S, C = values.shape
        count = len(self._steps)
        points = np.repeat(values[:, None], 1 + count, axis=1)
        points[:, 1:, :count] += np.diag(self._steps)
        flat = self.residual(points.reshape(-1, C), centre)
        r = flat.reshape(S, 1 + count, -1)
        base = r[:, 0]
        # A column that diverges where its base does not says nothing about the way to go.
        jac = np.nan_to_num((r[:, 1:] - base[:, None]) / self._steps[:, None], posinf=0.0, neginf=0.0)
        clean = np.nan_to_num(base)
        gradient, hessian = np.zeros((S, C)), np.zeros((S, C, C))
        gradient[:, :count] = np.einsum("scm,sm->sc", jac, clean)
        hessian[:, :count, :count] = np.einsum("scm,sdm->scd", jac, jac)
        return Linear(base, costs(base), gradient, hessian)

    def split(self, residual: FloatArray) -> tuple[FloatArray, ...]:
        """Return one residual, (M,), by episodes: (W, H, channels) each; without what is expected."""
        ends = np.cumsum([d.measured.size for d in self.windows])
        parts = np.split(residual[: ends[-1]], ends[:-1])
        return tuple(p.reshape(d.measured.shape) for p, d in zip(parts, self.windows, strict=True))


def costs(residual: FloatArray) -> FloatArray:
    """Return sums of squares, (N,), of residuals, (N, M); infinite where one diverged."""
    total = np.sum(residual**2, axis=1)
    return np.where(np.isfinite(total), total, np.inf)


class _MultiStart(Stepper):
    """One run: draw, refine in stages, draw again."""

    settings: GaussNewtonSettings
    KEPT = ("_stage", "_iteration", "_restarts", "_explained", "_drawn", "_values", "_cost", "_best")

    def __init__(self, log: SearchLog, rng: np.random.Generator, search: Search) -> None:
        super().__init__(log, rng, search)
        settings = self.settings
        self._low, self._high = value_bounds(self.problem)
        self._ticks = settings.noisy_ticks if is_noisy(self.problem) else settings.clean_ticks
        self._stage, self._iteration, self._restarts = -1, 0, 0
        self._innovations = Innovations(self.problem, self._ticks[0], follow=False)
        # The best draws so far with their scores, later the starts with their costs.
        self._values, self._cost, self._drawn = np.empty((0, len(self.problem.space) + 1)), np.empty(0), 0
        self._best: tuple[float, FloatArray] = (math.inf, self._midpoint())
        self._explained = False

    def _midpoint(self) -> FloatArray:
        middle = self.coordinates.members(np.full((1, self.coordinates.count), 0.5))
        return np.asarray(self._value_of(middle)[0], dtype=np.float64)

    def _value_of(self, members: Members) -> FloatArray:
        value = np.column_stack([self.problem.space.to_scale(members.theta), members.latency_s])
        return np.asarray(np.clip(value, *self._bounds()))

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        fixed = self.problem.fixed_latency_s
        if fixed is None:
            return self._low, self._high
        return np.append(self._low[:-1], fixed), np.append(self._high[:-1], fixed)

    @property
    def finished(self) -> bool:
        """Whether the residual is explained or the budget is used up."""
        return self._explained or len(self.log.trace) >= max(self.log.budget.generations, 1)

    def step(self) -> None:
        """Draw once more, or refine all starts by one iteration."""
        if self._stage < 0:
            self._draw()
        else:
            self._refine()

    def _draw(self) -> None:
        budget, settings = self.log.budget, self.settings
        members = self.coordinates.members(self.coordinates.sample(self.rng, budget.population))
        values = self._value_of(members)
        # One metric for all draws, that of the range's midpoint, and absolute values: most draws are so far
        # off that squares would rank them by their one worst window.
        score = np.mean(np.abs(self._innovations.residual(values, self._midpoint())), axis=1)
        pool = np.concatenate([self._values, values])
        scores = np.concatenate([self._cost, np.where(np.isfinite(score), score, np.inf)])
        order = np.argsort(scores, kind="stable")[: settings.starts]
        self._values, self._cost = pool[order], scores[order]
        self._drawn += len(values)
        best = float(self._cost[0])
        self.log.note(
            f"{self._drawn} draws: best {best:.3g}",
            members,
            {"stage": -1.0, "chi2": best**2, "starts": 0.0},
        )
        if self._best[0] == math.inf:
            self._best = (math.inf, self._values[0].copy())
        share = max(budget.generations // settings.draw_share, 1)
        if self._drawn >= min(settings.draws, share * budget.population):
            self._begin_stage(0)

    def _begin_stage(self, stage: int) -> None:
        self._stage, self._iteration = stage, 0
        self._innovations = Innovations(self.problem, self._ticks[stage], follow=stage > 0)

    def _refine(self) -> None:
        low, high = self._bounds()
        centre = self._values[0]
        linear = self._innovations.linear(self._values, centre)
        steps = [
            damped_step(value, linear.gradient[s], linear.hessian[s], damping, low, high, self._fixed)
            for s, value in enumerate(self._values)
            for damping in self.settings.dampings
        ]
        S, D = len(self._values), len(self.settings.dampings)
        tried = np.repeat(self._values, D, axis=0) + np.stack(steps)
        cost = costs(self._innovations.residual(tried, centre)).reshape(S, D)
        chosen = np.argmin(cost, axis=1)
        reached = cost[np.arange(S), chosen]
        better = reached < linear.cost
        moved = tried.reshape(S, D, -1)[np.arange(S), chosen]
        self._values = np.where(better[:, None], moved, self._values)
        after = np.where(better, reached, linear.cost)
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isfinite(linear.cost), (linear.cost - after) / linear.cost, 0.0)
        resting = np.nan_to_num(gain) < self.settings.converged
        order = np.argsort(after, kind="stable")
        self._values, self._cost = self._values[order], after[order]
        self._iteration += 1
        self._innovations.follow(self._values[0])
        self._note(linear.residual.shape[1])
        self._maybe_next(bool(resting[order[0]]), bool(resting.all()), linear.residual.shape[1])

    @property
    def _fixed(self) -> bool:
        return self.problem.fixed_latency_s is not None

    def _note(self, count: int) -> None:
        chi2, members = self._cost / count, self._innovations.members(self._values)
        self.log.note(
            f"windows of {self._ticks[self._stage]} ticks: chi2 {chi2[0]:.3g}, worst start {chi2[-1]:.3g}",
            members,
            {"stage": float(self._stage), "chi2": float(chi2[0]), "starts": float(len(chi2))},
        )

    def _maybe_next(self, best_rests: bool, all_rest: bool, count: int) -> None:
        """Go on to the next stage, or end this multi-start, where no more can be gained."""
        settings = self.settings
        chi2 = float(self._cost[0]) / count
        last = self._stage == len(self._ticks) - 1
        if last and chi2 <= self._best[0]:
            self._best = (chi2, self._values[0].copy())
        elif self._best[0] == math.inf:
            self._best = (math.inf, self._values[0].copy())
        # Once the best start explains everything there is nothing to wait for in the others.
        rests = all_rest or (best_rests and chi2 <= settings.restart_chi2)
        if not rests and self._iteration < settings.stage_generations:
            return
        if not last:
            self._values = self._values[: settings.survivors]
            self._begin_stage(self._stage + 1)
        elif chi2 <= settings.restart_chi2:
            self._explained = True
        else:
            self._restarts += 1
            self._values, self._cost, self._drawn = self._values[:0], self._cost[:0], 0
            self._stage = -1
            self._innovations = Innovations(self.problem, self._ticks[0], follow=False)

    def result(self) -> CalibrationResult:
        """Return the best start, with intervals from the normal equations there."""
        problem = self.problem
        innovations = Innovations(problem, self._ticks[-1], follow=True)
        value = self._best[1]
        innovations.follow(value)
        linear = innovations.linear(value[None], value)
        chi2 = float(linear.cost[0]) / linear.residual.shape[1]
        theta = problem.space.from_scale(value[:-1])
        latency = self.coordinates.clip_latency(float(value[-1]))
        residual, nothing = np.nan_to_num(linear.residual[0]), np.zeros(len(value))
        split = innovations.split(residual)
        known = uncertainty(
            problem.space,
            theta,
            latency,
            Normal(float(linear.cost[0]), residual.size, linear.hessian[0], nothing, split, nothing),
            chi2 if math.isfinite(chi2) else 1.0,
            problem.latency_range_s,
            fixed_latency=self._fixed,
            timing_std_s=problem.noise.timing_std_s,
        )
        last = self._values if len(self._values) else value[None]
        return self.log.result(
            innovations.members(value[None]),
            innovations.members(last),
            chi2=chi2,
            alarms=known.alarms,
            extra={"restarts": self._restarts, "interval": "90 %, from the normal equations"},
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=known.null_directions,
            latency_interval_s=known.latency_interval_s,
        )

    def save(self) -> dict[str, Any]:
        """See :class:`deal_hw.calib.search.resume.Kept`."""
        return {**super().save(), "offsets": copy.deepcopy(self._innovations.offsets)}

    def load(self, state: State) -> None:
        """See :class:`deal_hw.calib.search.resume.Kept`."""
        self._begin_stage(max(state["_stage"], 0))
        super().load(state)
        self._innovations.offsets = state["offsets"]


@dataclass(frozen=True)
class GaussNewton(Search):
    """Multi-start Levenberg-Marquardt on whitened window innovations."""

    name = "gauss-newton"
    stepper = _MultiStart
    settings: GaussNewtonSettings = field(default_factory=GaussNewtonSettings)


def damped_step(
    value: FloatArray,
    gradient: FloatArray,
    hessian: FloatArray,
    damping: float,
    low: FloatArray,
    high: FloatArray,
    fixed_latency: bool,
    *,
    step_limit: float = 0.7,
    latency_step_limit_s: float = 0.005,
) -> FloatArray:
    """Return the Levenberg-Marquardt step inside the range, (K + 1,).

    Args:
        value: Parameters in their own scale, then the latency [s], (K + 1,).
        gradient: Half the cost's gradient there, (K + 1,).
        hessian: Half its Gauss-Newton Hessian, (K + 1, K + 1).
        damping: How much shorter than the Gauss-Newton step.
        low: Least values, (K + 1,).
        high: Greatest values, (K + 1,).
        fixed_latency: Keep the latency.
        step_limit: Largest step of a parameter in its own scale (about a factor two).
        latency_step_limit_s: Largest step of the latency [s].
    """
    free = np.ones(len(value), dtype=bool)
    free[-1] = not fixed_latency
    # A parameter at its bound that wants to leave the range stays; the others are solved without it.
    free &= ~((value <= low) & (gradient > 0)) & ~((value >= high) & (gradient < 0))
    step = np.zeros(len(value))
    if not free.any():
        return step
    scale = np.append(np.ones(len(step) - 1), 100.0)  # 10 ms of latency count like a factor e.
    limit = np.append(np.full(len(step) - 1, step_limit), latency_step_limit_s)
    H = hessian[np.ix_(free, free)]
    # Levenberg's damping in units of the parameters' scale beside Marquardt's relative one: a parameter
    # that the data cannot see (a limit never reached) must not run away.
    weight = np.diag(H) + np.max(np.diag(H) / scale[free] ** 2) * 1e-9 * scale[free] ** 2 + scale[free] ** 2
    step[free] = -np.linalg.solve(H + damping * np.diag(weight), gradient[free])
    shrink = np.max(np.abs(step) / limit)
    if shrink > 1:
        step = step / shrink
    moved = np.asarray(np.clip(value + step, low, high) - value)
    if fixed_latency:
        moved[-1] = 0.0
    return moved
