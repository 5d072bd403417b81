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
