"""One step of least squares in residuals that are linearised already: as cheap as a few predictions.

A refinement simulates all derivatives anew at each step. Where a fit is nearly right, as that of half of the
windows that begins at the fit of all, derivatives that are known lead as far.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy
from scipy.optimize import lsq_linear

from deal_hw.calib.fit.refinement import Refined, refined_at
from deal_hw.calib.fit.residual import Normal, Point, Shooting, WindowRows, value_bounds
from deal_hw.calib.fit.solver import LATENCY_UNIT_S

KEPT_DECREASE = 0.5
"""Share of the expected decrease of the cost from which on the step holds [-]."""

NEGLIGIBLE_DECREASE = 1.0
"""Expected decrease that needs no such proof [noise variances]: less than one standard deviation."""


def one_step(fit: Refined) -> Refined | None:
    """Return a fit after one step; None where the cost does not fall as expected: residuals bend too much.

    Args:
        fit: The fit, with linearised residuals.
    """
    shooting, point, normal = fit.shooting, fit.point, fit.normal
    # |r + J d|^2 + |d / unit|^2 with J^T J = H and J^T r = g, in the bounds; the last is the solver's hold.
    unit = np.append(np.ones(len(point.value) - 1), LATENCY_UNIT_S)
    free = np.append(np.ones(len(unit) - 1, dtype=bool), not shooting.fixed_latency)
    root = np.linalg.cholesky((normal.hessian + np.diag(unit**-2))[np.ix_(free, free)])
    wanted = -scipy.linalg.solve_triangular(root, normal.gradient[free], lower=True)
    low, high = value_bounds(shooting.problem)
    box = np.minimum(low - point.value, 0.0)[free], np.maximum(high - point.value, 0.0)[free]
    inner = box[1] > box[0]
    step = np.zeros_like(point.value)
    solved = lsq_linear(root.T[:, inner], wanted, (box[0][inner], box[1][inner]), method="bvls")
    step[np.flatnonzero(free)[inner]] = solved.x
    moved = shooting.followed(point, normal, step)
    slope = normal.hessian @ step
    expected = -float(step @ (2 * normal.gradient + slope))
    cost = shooting.cost(moved)
    if expected > NEGLIGIBLE_DECREASE and not normal.cost - cost > KEPT_DECREASE * expected:
        return None
    # Start states have followed, so nothing of the residual is left along theirs.
    rows = tuple(dataclasses.replace(r, residual=r.rest + r.following @ step) for r in normal.rows)
    there = dataclasses.replace(
        normal,
        cost=cost,
        gradient=normal.gradient + slope,
        residual=tuple(shooting.residuals(moved)),
        rows=rows,
    )
    return refined_at(shooting, moved, there, fit.iterations)


def of_rows(shooting: Shooting, point: Point, normal: Normal, rows: tuple[WindowRows, ...]) -> Normal:
    """Return normal equations with the hessian and the gradient of these rows."""
    K = len(point.value)
    hessian = np.diag(normal.prior)
    gradient = normal.prior * (point.value - shooting.prior_mean)
    for r in rows:
        by = r.following.reshape(-1, K)
        hessian = hessian + by.T @ by
        gradient = gradient + by.T @ r.residual.ravel()
    return dataclasses.replace(normal, hessian=hessian, gradient=gradient, rows=rows)
