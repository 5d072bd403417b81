"""The solver inside bounds, on linear problems, whose solution a library gives."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from deal_hw.calib.fit.solver import SolverSettings, minimise


class Linear:
    """Residuals that are linear in the values."""

    def __init__(self, rows: np.ndarray, wanted: np.ndarray) -> None:
        self.rows, self.wanted = rows, wanted

    def residual(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return np.asarray(self.rows @ value - self.wanted)

    def jacobian(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return self.rows


def test_a_fit_does_not_end_beside_a_bound() -> None:
    """Started twice, with a latency at its lower end: the cost is the least one in 300 random problems.

    Without a look at all parameters together, 4 of them ended where one at its bound stopped the others.
    """
    settings = SolverSettings(converged=2e-3, reach=1e6)
    low, high = np.full(8, -0.3), np.full(8, 0.3)
    low[-1], high[-1] = 0.0, 0.04
    stuck = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        rows = rng.normal(size=(30, 8)) @ (np.eye(8) + 0.9 * rng.normal(size=(8, 8)))
        rows[:, -1] *= 100.0
        problem = Linear(rows, rng.normal(size=30))
        value = np.zeros(8)
        for _ in range(2):
            value, _ = minimise(problem, value, (low, high), settings, fixed_latency=False)
        best = lsq_linear(rows, problem.wanted, (low, high), method="bvls").x
        cost, least = (float(np.sum(problem.residual(x) ** 2)) for x in (value, best))
        if cost > 1.01 * least:
            stuck.append(seed)
    assert not stuck


def test_one_derivative_solves_a_linear_problem_of_many_parameters() -> None:
    """92 parameters, many of which end at their range: one exact step. Steps to the first bound need many.

    The solution is that of a library, to 1e-6 of its cost.
    """
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(400, 93)) * np.logspace(-2, 2, 93)
    problem = Linear(rows, rows @ rng.normal(size=93))
    low, high = np.full(93, -0.5), np.full(93, 0.5)
    settings = SolverSettings(reach=1e6)
    value, used = minimise(problem, np.zeros(93), (low, high), settings, fixed_latency=True)
    best = lsq_linear(rows[:, :92], problem.wanted, (low[:92], high[:92]), method="bvls", max_iter=1000).x
    cost = float(np.sum(problem.residual(value) ** 2))
    least = float(np.sum(problem.residual(np.append(best, 0.0)) ** 2))
    assert np.count_nonzero(np.abs(value) >= 0.5) > 30
    assert cost < least * (1 + 1e-6)
    # The second shows that nothing is left to gain.
    assert used <= 2


class Curved:
    """Residuals exp(rows x) - wanted, and how often their derivatives were asked for."""

    def __init__(self, rows: np.ndarray, wanted: np.ndarray) -> None:
        self.rows, self.wanted, self.asked = rows, wanted, 0

    def residual(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        return np.asarray(np.exp(self.rows @ value) - self.wanted)

    def jacobian(self, value: np.ndarray) -> np.ndarray:
        """See :class:`deal_hw.calib.fit.solver.LeastSquares`."""
        self.asked += 1
        return np.asarray(np.exp(self.rows @ value)[:, None] * self.rows)


def test_carried_derivatives_end_in_the_same_minimum_with_fewer_derivatives() -> None:
    """Twenty curved problems with noise: the same cost to 1e-5 as with a derivative each step, for fewer.

    scipy's solver, from the solution on, finds no lower cost.
    """
    asked = np.zeros(2, dtype=int)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows, truth = 0.6 * rng.normal(size=(40, 7)), 0.8 * rng.normal(size=7)
        truth[-1] = 0.0
        wanted = np.exp(rows @ truth) + 0.05 * rng.normal(size=40)
        low, high = np.full(7, -3.0), np.full(7, 3.0)
        costs = []
        for k, secants in enumerate((0, 3)):
            problem = Curved(rows, wanted)
            settings = SolverSettings(iterations=40, converged=1e-10, reach=1e6, secants=secants)
            value, used = minimise(problem, np.zeros(7), (low, high), settings, fixed_latency=True)
            assert used == problem.asked
            asked[k] += used
            costs.append(float(np.sum(problem.residual(value) ** 2)))
        # The latency, last, is fixed at 0.
        free = least_squares(Curved(rows[:, :-1], wanted).residual, value[:-1])
        np.testing.assert_allclose(costs, 2 * free.cost, rtol=1e-5)
    assert asked[1] < 0.6 * asked[0]


def test_a_step_with_carried_derivatives_is_the_secant_of_one_unknown() -> None:
    """By hand, for r = x^2 - 2 from 1: x = 1.5 with the derivative 2, then with the secant 2.5 x = 1.4.

    Broyden's update of one unknown is the secant: (r(1.5) - r(1)) / 0.5 = 2.5, and 1.5 - 0.25 / 2.5 = 1.4.
    """
    seen = []

    class Root:
        def residual(self, value: np.ndarray) -> np.ndarray:
            seen.append(float(value[0]))
            return np.asarray(value[:1] ** 2 - 2.0)

        def jacobian(self, value: np.ndarray) -> np.ndarray:
            return np.array([[2.0 * value[0], 0.0]])

    settings = SolverSettings(iterations=1, reach=1e9, secants=1)
    bounds = np.array([0.0, 0.0]), np.array([9.0, 0.0])
    value, used = minimise(Root(), np.array([1.0, 0.0]), bounds, settings, fixed_latency=True)
    assert used == 1
    np.testing.assert_allclose(seen[:3], [1.0, 1.5, 1.4], rtol=1e-9)
    assert value[0] == seen[2]


def test_a_step_that_carried_derivatives_mislead_is_taken_again_with_new_ones() -> None:
    """Most secants are allowed, but a refused step, or one that gains too little, asks for a derivative."""
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(30, 5))
    wanted = np.exp(rows @ np.array([1.0, -1.0, 0.5, 0.7, 0.0]))
    problem = Curved(rows, wanted)
    low, high = np.full(5, -3.0), np.full(5, 3.0)
    settings = SolverSettings(iterations=30, converged=1e-12, reach=1e6, secants=30)
    value, used = minimise(problem, np.zeros(5), (low, high), settings, fixed_latency=True)
    assert used > 1
    np.testing.assert_allclose(value[:-1], [1.0, -1.0, 0.5, 0.7], atol=1e-5)
