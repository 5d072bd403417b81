"""The solver inside bounds, on linear problems, whose solution a library gives."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

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
