"""Solver for feet in contact with the floor: a strategy beside the one solver, with secants for start states.

Feet that stick and slip make kinks in every prediction. A full Gauss-Newton step of all start states at once
rarely helps, and a solver that requires it stops at poor start states. On Go2 targets with sensor noise,
windows from smoothed start states cost six times the noise at the true parameters. Their residuals were
correlated over 5 to 13 samples. But given the parameters, windows are independent. So after each parameter
step every window takes its best start-state update, then a damped step of its own. Predictions are linearised
by secants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.fit.residual import Normal, Point, Shooting, value_bounds
from deal_hw.calib.fit.solver import SolverSettings, minimise
from deal_hw.types import FloatArray

START_DAMPINGS = (1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Levenberg damping of start states, in units of the smoothed states' standard deviations; each window
takes the best."""

FOLLOW = (0.0, 0.5, 1.0)
"""Shares of the linear start-state update after a parameter step. Because of kinks the full update is too
long as often as right."""

STRETCHES = (1.0, -1.0, 2.5, -0.4)
"""Secant lengths, used in turn: forward, backward, far and near ones miss different kinks."""

LEAST_GAIN = 1.0
"""A smaller decrease of the cost is noise from kinks."""

PATIENCE = 3
"""Most consecutive runs of the solver without gain."""

START_ITERATIONS = 4
"""Most steps of start states alone."""


def solve_contacts(shooting: Shooting, point: Point, iterations: int) -> tuple[Point, Normal, int]:
    """Solve for parameters and start states; return the best point, its normal equations, and derivatives."""
    best, best_cost = fit_starts(shooting, point, START_ITERATIONS)
    bounds, waited, used = value_bounds(shooting.problem), 0, 0
    while used < iterations and waited <= PATIENCE:
        fit = Sticking(shooting, best, STRETCHES[waited % len(STRETCHES)])
        settings = SolverSettings(iterations=iterations - used)
        _, more = minimise(fit, best.value, bounds, settings, fixed_latency=shooting.fixed_latency)
        used += max(more, 1)
        fell = best_cost - fit.best_cost
        if fell > 0:
            best, best_cost = fit.best, fit.best_cost
        waited = 0 if fell > LEAST_GAIN else waited + 1
    best, _ = fit_starts(shooting, best, START_ITERATIONS // 2)
    return best, shooting.normal(best), used


@dataclass(frozen=True, slots=True)
class _Followed:
    """A point with updated start states; normal equations and gains before, residuals (M,) after."""

    point: Point
    normal: Normal
    gains: Sequence[FloatArray]
    residual: FloatArray


class Sticking:
    """The residual as a function of the parameters; start states of sticking and slipping feet follow them.

    ``stretch`` is a factor on the secants' steps, negative for backward ones. ``best`` is the point of the
    lowest cost so far.
    """

    def __init__(self, shooting: Shooting, point: Point, stretch: float) -> None:
        self._shooting, self._stretch = shooting, stretch
        self.best, self.best_cost = point, np.inf
        self._last = self._here = self._followed(point)

    def residual(self, value: FloatArray) -> FloatArray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        if not np.array_equal(self._last.point.value, value):
            here, step = self._here.point, value - self._here.point.value
            ways = [np.stack([-share * (gain @ step) for share in FOLLOW]) for gain in self._here.gains]
            self._last = self._followed(self._shooting.moved(here, value, ways))
        return self._last.residual

    def jacobian(self, value: FloatArray) -> FloatArray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        self.residual(value)
        self._here = self._last
        return self._shooting.derivative(self._here.normal)

    def _followed(self, point: Point) -> _Followed:
        """Improve the start states at a point once, and linearise."""
        normal = self._shooting.normal(point, keep=True, stretch=self._stretch)
        point, gains = _stepped(self._shooting, point, normal)
        found = _Followed(point, normal, gains, self._shooting.vector(point))
        cost = float(found.residual @ found.residual)
        if cost < self.best_cost:
            self.best, self.best_cost = point, cost
        return found


def fit_starts(shooting: Shooting, point: Point, iterations: int) -> tuple[Point, float]:
    """Fit start states alone; parameters stay, and no window's cost grows. Return the point and its cost."""
    cost = shooting.cost(point)
    for number in range(iterations):
        normal = shooting.normal(point, keep=True, stretch=STRETCHES[number % 2])
        point, _ = _stepped(shooting, point, normal)
        before, cost = cost, shooting.cost(point)
        if before - cost < LEAST_GAIN:
            break
    return point, cost


def _stepped(shooting: Shooting, point: Point, normal: Normal) -> tuple[Point, list[FloatArray]]:
    """Return the point after each window's best damped step, and the gains there, (W, S, P) each.

    A gain is the derivative of the best start states by the parameters.
    """
    scale = np.maximum(shooting.state_std, 1e-12)
    gains, ways = [], []
    for rows in normal.rows:
        js = rows.start * scale
        square = np.einsum("wri,wrj->wij", js, js)
        own = np.einsum("wri,wr->wi", js, rows.residual)[..., None]
        unit = np.eye(len(scale))
        steps = [np.linalg.solve(square + d * unit, own)[..., 0] * scale for d in START_DAMPINGS]
        ways.append(-np.stack([np.zeros_like(steps[0]), *steps]))
        cross = np.einsum("wri,wrj->wij", js, rows.parameter)
        gains.append(np.linalg.solve(square, cross) * scale[:, None])
    return shooting.moved(point, point.value, ways), gains
