"""Least squares on a residual of one's own: any function of predictions that noise alone would leave.

Symbols are those of :mod:`deal_hw.calib.fit.residual`, with given start states: the residuals r_w(p) of
window w depend on parameters and latency p alone, and f(p) = (p - q)^T P (p - q) + sum_w r_w^T r_w.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.refinement import Refined, refined_at
from deal_hw.calib.fit.residual import LATENCY_STEP_S, Normal, Point, Shooting, WindowRows, value_bounds
from deal_hw.types import FloatArray

Residual: TypeAlias = Callable[[WindowData, FloatArray], FloatArray]
"""Whitened residuals, (N, W, H, J), of the predictions of N members, (N, W, H, M), in an episode's windows.

A whitened residual is divided by the standard deviation that its noise has. J is free.
"""


@dataclass(frozen=True)
class OwnResidual:
    """A fit of parameters and latency to a residual of one's own, for any solver.

    It is a :class:`~deal_hw.calib.fit.solver.LeastSquares`: :func:`~deal_hw.calib.fit.solver.minimise` takes
    it, and so does any solver that asks for residuals and their derivatives. Samples that were not reported
    count for nothing.

    Attributes:
        windows: The windows, from their smoothed states (``given=True``), and the parameters' priors.
        of: The residual.
    """

    windows: Shooting
    of: Residual

    def start(self) -> FloatArray:
        """Return the nominal parameters in their own scale and the first latency, (K + 1,)."""
        problem = self.windows.problem
        return np.append(problem.space.to_scale(problem.space.nominal), problem.first_latency_s)

    def residual(self, value: FloatArray) -> FloatArray:
        """Return all residuals at parameters in their own scale and latency, (K + 1,); priors last, (M,)."""
        rows = [r[0].ravel() for r in self._at(value[None])]
        return np.concatenate([*rows, self._root * (value - self.windows.prior_mean)])

    def jacobian(self, value: FloatArray) -> FloatArray:
        """Return their derivatives, (M, K + 1)."""
        rows = [by.reshape(-1, len(value)) for _, by in self._linearised(value)]
        return np.concatenate([*rows, np.diag(self._root)])

    def refined(self, value: FloatArray) -> Refined:
        """Return the fit at a solution, (K + 1,), for intervals and verdicts."""
        return refined_at(self.windows, self._point(value), self.normal(value))

    def normal(self, value: FloatArray) -> Normal:
        """Return the normal equations at parameters and latency, (K + 1,), with their rows."""
        known, off = self.windows.prior_information, value - self.windows.prior_mean
        hessian, gradient, cost, count = np.diag(known), known * off, float(known @ off**2), 0
        residuals, rows = [], []
        for data, (r, by) in zip(self.windows.data, self._linearised(value), strict=True):
            flat, jac = r.reshape(len(r), -1), by.reshape(len(r), -1, len(value))
            # H = P + sum_w J_w^T J_w, g = P (p - q) + sum_w J_w^T r_w: Gauss-Newton.
            hessian = hessian + np.einsum("wri,wrj->ij", jac, jac)
            gradient = gradient + np.einsum("wri,wr->i", jac, flat)
            cost += float(np.sum(flat**2))
            count += r.shape[-1] * int(np.count_nonzero(np.any(data.reported, axis=2)))
            residuals.append(r)
            rows.append(WindowRows(flat, jac, np.zeros((*flat.shape, 0))))
        return Normal(cost, count, hessian, gradient, tuple(residuals), known, (), tuple(rows))

    @property
    def _root(self) -> FloatArray:
        return np.asarray(np.sqrt(self.windows.prior_information))

    def _point(self, value: FloatArray) -> Point:
        space = self.windows.problem.space
        return self.windows.start(space.from_scale(value[:-1]), float(value[-1]))

    def _linearised(self, value: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return an episode's residuals, (W, H, J), and their derivatives, (W, H, J, K + 1)."""
        steps = np.append(np.full(len(value) - 1, self.windows.parameter_step), LATENCY_STEP_S)
        # A value at the upper end of its range has no neighbour above.
        steps = np.where(value + steps > value_bounds(self.windows.problem)[1], -steps, steps)
        found = self._at(np.concatenate([value[None], value + np.diag(steps)]))
        # dr/dp_k = (r(p + h_k e_k) - r(p)) / h_k; its error is of the first order in h.
        return [(r[0], np.moveaxis(r[1:] - r[0], 0, -1) / steps) for r in found]

    def _at(self, values: FloatArray) -> list[FloatArray]:
        """Return the residuals of N members, (N, K + 1), an episode each, (N, W, H, J)."""
        problem, found = self.windows.problem, []
        theta = problem.space.from_scale(values[:, :-1])
        for data in self.windows.data:
            r = self.of(data, problem.predict(theta, values[:, -1], data).observed)
            seen = np.any(data.reported, axis=2, keepdims=True)
            found.append(np.where(seen, r, 0.0))
        return found
