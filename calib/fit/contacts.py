"""Where feet touch the floor: the strategy beside the one solver, start states following by secants.

Feet that stick and slip kink every prediction, so the full Gauss-Newton step of all start states at once
hardly ever helps, and a solver that insists on it stops with start states that explain nothing: measured on
sensed Go2 targets, windows started from smoothed states cost six times the noise at the true parameters, and
what was left was correlated over 5 to 13 samples. Given the parameters, though, windows do not depend on each
other. So after a step of the parameters each window takes that way of following which suits it best, then a
damped step of its own, and predictions are linearised by secants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.fit.residual import Normal, Point, Shooting, value_bounds
from deal_hw.calib.fit.solver import SolverSettings, minimise
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactSettings:
    """Settings of the strategy where feet touch the floor.

    Attributes:
        start_dampings: Levenberg's damping of start states, in units of the smoothed states' standard
            deviations; each window takes the best.
        follow: How far start states follow a parameter step: kinks make the derivative too long as often as
            right.
        stretches: Secants, in turns: forward, backward, far and near ones miss different kinks.
        gain: A cost that falls by less is noise of the kinks.
        patience: So many runs of the solver without gain are the last.
        start_iterations: Most steps of start states alone.
    """

    start_dampings: tuple[float, ...] = (1e-2, 1e-1, 1.0, 10.0, 100.0)
    follow: tuple[float, ...] = (0.0, 0.5, 1.0)
    stretches: tuple[float, ...] = (1.0, -1.0, 2.5, -0.4)
    gain: float = 1.0
    patience: int = 3
    start_iterations: int = 4


CONTACTS = ContactSettings()


def solve_contacts(
    shooting: Shooting, point: Point, iterations: int, *, fixed_latency: bool
) -> tuple[Point, Normal, int]:
    """Solve for parameters and start states; the best point that was seen is handed back.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most derivatives of the solver.
        fixed_latency: Keep the latency.
    """
    best, best_cost = settle(shooting, point, CONTACTS.start_iterations)
    bounds, waited, used = value_bounds(shooting.problem), 0, 0
    while used < iterations and waited <= CONTACTS.patience:
        fit = Sticking(shooting, best, CONTACTS.stretches[waited % len(CONTACTS.stretches)])
        settings = SolverSettings(iterations=iterations - used)
        _, more = minimise(fit, best.value, bounds, settings, fixed_latency=fixed_latency)
        used += max(more, 1)
        fell = best_cost - fit.best_cost
        if fell > 0:
            best, best_cost = fit.best, fit.best_cost
        waited = 0 if fell > CONTACTS.gain else waited + 1
    best, _ = settle(shooting, best, CONTACTS.start_iterations // 2)
    return best, shooting.normal(best), used


@dataclass(frozen=True, slots=True)
class _Followed:
    """Where start states followed to: the point, normal equations and gains before, residuals there, (M,)."""

    point: Point
    normal: Normal
    gains: Sequence[FloatArray]
    residual: FloatArray


class Sticking:
    """The residual as a function of the parameters, start states of feet that stick and slip following.

    Args:
        shooting: The windows.
        point: Where to start.
        stretch: Factor on the secants' steps; negative for backward ones.

    Attributes:
        best: The point that cost least so far.
        best_cost: Its cost.
    """

    def __init__(self, shooting: Shooting, point: Point, stretch: float) -> None:
        self._shooting, self._stretch = shooting, stretch
        self.best, self.best_cost = point, np.inf
        self._last = self._here = self._followed(point)

    def residual(self, value: FloatArray) -> FloatArray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        if not np.array_equal(self._last.point.value, value):
            here, step = self._here.point, value - self._here.point.value
            ways = [
                np.stack([-share * (gain @ step) for share in CONTACTS.follow]) for gain in self._here.gains
            ]
            self._last = self._followed(self._shooting.moved(here, value, ways))
        return self._last.residual

    def jacobian(self, value: FloatArray) -> FloatArray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        self.residual(value)
        self._here = self._last
        return self._shooting.derivative(self._here.normal)

    def _followed(self, point: Point) -> _Followed:
        """Return where start states settle from a point, with what is known there."""
        normal = self._shooting.normal(point, keep=True, stretch=self._stretch)
        point, gains = _settled(self._shooting, point, normal)
        found = _Followed(point, normal, gains, self._shooting.vector(point))
        cost = float(found.residual @ found.residual)
        if cost < self.best_cost:
            self.best, self.best_cost = point, cost
        return found


def settle(shooting: Shooting, point: Point, iterations: int) -> tuple[Point, float]:
    """Fit start states alone; parameters stay, and no window's cost grows.

    Args:
        shooting: The windows.
        point: Where to start.
        iterations: Most steps.

    Returns:
        The point and its cost.
    """
    cost = shooting.cost(point)
    for number in range(iterations):
        normal = shooting.normal(point, keep=True, stretch=CONTACTS.stretches[number % 2])
        point, _ = _settled(shooting, point, normal)
        before, cost = cost, shooting.cost(point)
        if before - cost < CONTACTS.gain:
            break
    return point, cost


def _settled(shooting: Shooting, point: Point, normal: Normal) -> tuple[Point, list[FloatArray]]:
    """Return the point after each window's best damped step, and the gains there, (W, S, P) each.

    A gain is by what start states follow the parameters.
    """
    scale = np.maximum(shooting.state_std, 1e-12)
    gains, ways = [], []
    for rows in normal.rows:
        js = rows.start * scale
        square = np.einsum("wri,wrj->wij", js, js)
        own = np.einsum("wri,wr->wi", js, rows.residual)[..., None]
        unit = np.eye(len(scale))
        steps = [np.linalg.solve(square + d * unit, own)[..., 0] * scale for d in CONTACTS.start_dampings]
        ways.append(-np.stack([np.zeros_like(steps[0]), *steps]))
        cross = np.einsum("wri,wrj->wij", js, rows.parameter)
        gains.append(np.linalg.solve(square, cross) * scale[:, None])
    return shooting.moved(point, point.value, ways), gains
