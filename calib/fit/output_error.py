"""Open-loop fit: least squares on long predictions from smoothed states, as a held-out recording is judged.

Multiple shooting explains every sample with start states of its own, which a model that lacks something
(backlash, a friction law, a slipped clock) uses to explain what is no start state. Over windows of seconds a
damped robot forgets where it began, so start states need no fit, and what is minimised is what a user wants
small: the error of a prediction. Each channel is measured by its own residual, which is estimated together
with the parameters, so nobody has to say how good the model is. Residuals of a wrong model hang together:
they count as so many as they have correlation times, and the search range is the prior for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem, WindowData
from deal_hw.calib.fit.refinement import damped_step, value_bounds
from deal_hw.calib.fit.residual import LATENCY_STEP_S, PARAMETER_STEP, WindowRows
from deal_hw.calib.fit.robust import huber_weights
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

ITERATIONS = 20
DAMPINGS = 10.0 ** np.arange(-4.0, 3.0, 1.5)
CONVERGED = 2e-3
"""An iteration that lowers the cost by a smaller share is the last: held-out motion does not see it."""

MAD_TO_STD = 1.4826022185056018
LEAST_SCALE = 1e-9
"""Residuals of a noise-free recording that the model explains are rounding [rad or m]."""

LONGEST_LAG_S = 1.0
"""Correlation of residuals is looked for up to here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How to fit.

    Attributes:
        seconds: Length of the windows; shorter where no stretch is so long.
        latency: Fit the latency; otherwise it stays that of the start.
        prior_std: Spread of parameters around their nominal values, as a share of their range in its own
            scale; infinite for none. By default as wide as the range itself.
        robust: Large residuals weigh less (Huber).
    """

    seconds: float = 2.0
    latency: bool = True
    prior_std: float = 0.289
    robust: bool = False


SHORT = Recipe(seconds=0.2)
"""Windows in which even a far start does not diverge."""


@dataclass(frozen=True, slots=True)
class HorizonFit:
    """Where an open-loop fit ended, with predictions linearised there.

    Attributes:
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        scale: What residuals were measured by, channel by channel, (M,): their root mean square, or where the
            loss is robust their middle.
        hessian: Normal matrix of residuals over ``scale``, parameters in their own scale and the latency, no
            prior in it, (K + 1, K + 1).
        gradient: Half the gradient of their sum of squares, (K + 1,).
        rows: Weighed residuals and their derivatives, window by window.
        residual: Residuals over ``scale`` per recording, (W, H, M).
        iterations: Iterations used.
    """

    theta: FloatArray
    latency_s: float
    scale: FloatArray
    hessian: FloatArray
    gradient: FloatArray
    rows: tuple[WindowRows, ...]
    residual: tuple[FloatArray, ...]
    iterations: int


def fit_horizon(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    recipe: Recipe,
    *,
    iterations: int = ITERATIONS,
    central: bool = False,
) -> HorizonFit:
    """Fit from a start.

    Args:
        problem: Recordings and simulator.
        theta: Start, (K,).
        latency_s: Its latency [s].
        recipe: How.
        iterations: Most iterations; 0 to linearise at the start.
        central: Linearise the end by central differences, for what is said of the parameters there.

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    space = problem.space
    low, high = problem.latency_range_s
    if problem.fixed_latency_s is None:
        latency_s = min(max(latency_s, low), high)
    value = np.append(space.to_scale(np.clip(theta, space.low, space.high)), latency_s)
    stage = _Stage(problem, longest_windows(problem, recipe.seconds), recipe)
    value, used = stage.solve(value, iterations)
    return stage.summary(value, used, central=central)


def prediction_rmse(
    problem: Problem, members: Sequence[tuple[FloatArray, float]], seconds: float
) -> FloatArray:
    """Return root mean square errors of open-loop predictions from smoothed states, (N, M).

    Args:
        problem: Recordings to predict.
        members: Physical parameters, (K,), and latency [s] of each.
        seconds: Length of the windows.
    """
    space = problem.space
    values = np.stack([np.append(space.to_scale(theta), latency) for theta, latency in members])
    stage = _Stage(problem, longest_windows(problem, seconds), Recipe())
    return stage.rmse(stage.residuals(values))


def longest_windows(problem: Problem, seconds: float) -> list[WindowData]:
    """Cut windows of so many seconds, shorter ones where no recording holds one.

    Raises:
        InsufficientDataError: Not even windows of four samples fit.
    """
    length = max(round(seconds / problem.episodes[0].period_s), 4)
    while True:
        try:
            return problem.windows(length)
        except InsufficientDataError:
            if length <= 4:
                raise
            length = max(int(0.8 * length), 4)


def expected_residual(problem: Problem) -> FloatArray:
    """Return what predictions of real recordings may be off, positions then velocities, (2 C,).

    The residual of a fit over short windows from the model's own values, at least the sensor noise: what a
    search is to be told where nobody knows how good the model is.

    Args:
        problem: Recordings and simulator.
    """
    fit = fit_horizon(problem, problem.space.nominal, problem.first_latency_s, SHORT)
    std = problem.noise_std.copy()
    std[problem.channels] = np.maximum(std[problem.channels], fit.scale)
    return std


class _Stage:
    """Predictions of one cut into windows.

    Args:
        problem: Recordings and simulator.
        data: The windows.
        recipe: How to fit.
    """

    def __init__(self, problem: Problem, data: Sequence[WindowData], recipe: Recipe) -> None:
        self._problem, self._data, self._recipe = problem, data, recipe
        space = problem.space
        self._fixed = not recipe.latency or problem.fixed_latency_s is not None
        self._low, self._high = value_bounds(problem)
        mean, std = space.prior
        width = recipe.prior_std * space.width
        # What is known by other means counts beside the range.
        self._information = 1 / std**2 + 1 / width**2
        centre = space.to_scale(mean) / std**2 + space.to_scale(space.nominal) / width**2
        known = self._information > 0
        self._centre = np.where(known, centre / np.where(known, self._information, 1.0), 0.0)
        self._seen = [np.isfinite(d.std) for d in data]

    def residuals(self, values: FloatArray) -> list[FloatArray]:
        """Return prediction minus measurement per episode, (N, W, H, M); 0 where nothing was reported."""
        theta, latency = self._problem.space.from_scale(values[:, :-1]), np.maximum(values[:, -1], 0.0)
        found = []
        for data, seen in zip(self._data, self._seen, strict=True):
            error = self._problem.predict(theta, latency, data).observed - data.measured
            found.append(np.where(seen, error, 0.0))
        return found

    def rmse(self, residuals: Sequence[FloatArray]) -> FloatArray:
        """Return the root mean square of each channel, (N, M); infinite where a member diverged."""
        squares = np.sum([np.sum(r**2, axis=(1, 2)) for r in residuals], axis=0)
        counts = np.sum([np.sum(s, axis=(0, 1)) for s in self._seen], axis=0)
        mean = np.where(np.isfinite(squares), squares, np.inf) / np.maximum(counts, 1)
        return np.asarray(np.sqrt(mean), dtype=np.float64)

    def solve(self, value: FloatArray, iterations: int) -> tuple[FloatArray, int]:
        """Iterate from a value, (K + 1,); return where it ended and the iterations."""
        used = 0
        for _ in range(iterations):
            used += 1
            residual, jacobian = self._linear(value)
            weights, _, _ = self._weights(residual)
            gradient, hessian = self._normal(value, residual, jacobian, weights)
            steps = [
                damped_step(value, gradient, hessian, d, self._low, self._high, self._fixed) for d in DAMPINGS
            ]
            tried = np.stack([value + step for step in steps])
            costs = self._costs(tried, weights)
            before = self._cost_of(value, [r[None] for r in residual], weights)[0]
            best = int(np.argmin(costs))
            if not costs[best] < before:
                break
            value = tried[best]
            if before - costs[best] < CONVERGED * before:
                break
        return value, used

    def summary(self, value: FloatArray, used: int, *, central: bool) -> HorizonFit:
        """Return what is known at a value, (K + 1,)."""
        residual, jacobian = self._linear(value)
        if central:
            # A one-sided difference's truncation looks like information where there is none.
            backward = self._linear(value, -1.0)[1]
            jacobian = [(a + b) / 2 for a, b in zip(jacobian, backward, strict=True)]
        weights, scale, correlation = self._weights(residual)
        gradient, hessian = np.zeros(len(value)), np.zeros((len(value), len(value)))
        rows = []
        for data, r, j, w in zip(self._data, residual, jacobian, weights, strict=True):
            W = len(r)
            root = np.sqrt(w * correlation).reshape(W, -1)
            flat, by = root * r.reshape(W, -1), root[..., None] * j.reshape(W, -1, len(value))
            hessian += np.einsum("wri,wrj->ij", by, by)
            gradient += np.einsum("wri,wr->i", by, flat)
            rows.append(WindowRows(data.episode, flat, by, np.zeros((*flat.shape, 0))))
        return HorizonFit(
            theta=self._problem.space.from_scale(value[:-1]),
            latency_s=float(value[-1]),
            scale=scale,
            hessian=hessian,
            gradient=gradient,
            rows=tuple(rows),
            residual=tuple(r / scale for r in residual),
            iterations=used,
        )

    def _linear(self, value: FloatArray, way: float = 1.0) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return residuals, (W, H, M), and their derivatives, (W, H, M, K + 1), of each episode.

        Args:
            value: Where, (K + 1,).
            way: 1 for forward differences, -1 for backward ones; what leaves the range goes the other way.
        """
        K = len(value) - 1
        steps = np.append(np.full(K, PARAMETER_STEP), LATENCY_STEP_S)
        count = K + (not self._fixed)
        values = np.repeat(value[None], 1 + count, axis=0)
        sign = np.full(K + 1, way)
        sign[value + way * steps > self._high] = -1.0
        sign[value + way * steps < self._low] = 1.0
        values[1:] += np.diag(sign * steps)[:count]
        residuals, jacobians = [], []
        for r in self.residuals(values):
            base = r[0]
            difference = np.moveaxis(r[1:] - base, 0, -1) / (sign * steps)[:count]
            jacobian = np.zeros((*base.shape, K + 1))
            # A column that diverges where its base does not says nothing about the way to go.
            jacobian[..., :count] = np.nan_to_num(difference, nan=0.0, posinf=0.0, neginf=0.0)
            residuals.append(np.nan_to_num(base))
            jacobians.append(jacobian)
        return residuals, jacobians

    def _weights(self, residual: Sequence[FloatArray]) -> tuple[list[FloatArray], FloatArray, float]:
        """Return residuals' weights, each channel's scale, (M,), and how many samples count as one."""
        squares = np.sum([np.sum(r**2, axis=(0, 1)) for r in residual], axis=0)
        counts = np.sum([np.sum(s, axis=(0, 1)) for s in self._seen], axis=0)
        scale = np.sqrt(squares / np.maximum(counts, 1))
        if self._recipe.robust:
            # The middle of the residuals measures them, or a channel that fails somewhere counts nowhere.
            middle = [np.abs(r).reshape(-1, r.shape[-1]) for r in residual]
            scale = np.minimum(scale, MAD_TO_STD * np.median(np.concatenate(middle), axis=0))
        scale = np.maximum(scale, LEAST_SCALE)
        whitened = [r / scale for r in residual]
        correlation = _correlation_samples(
            whitened, round(LONGEST_LAG_S / self._problem.episodes[0].period_s)
        )
        weights = []
        for r, seen in zip(whitened, self._seen, strict=True):
            w = huber_weights(r) if self._recipe.robust else np.ones_like(r)
            weights.append(np.where(seen, w / scale**2 / correlation, 0.0))
        return weights, scale, correlation

    def _normal(
        self,
        value: FloatArray,
        residual: Sequence[FloatArray],
        jacobian: Sequence[FloatArray],
        weights: Sequence[FloatArray],
    ) -> tuple[FloatArray, FloatArray]:
        gradient = np.append(self._information * (value[:-1] - self._centre), 0.0)
        hessian = np.diag(np.append(self._information, 0.0))
        for r, j, w in zip(residual, jacobian, weights, strict=True):
            flat = j.reshape(-1, len(value))
            weighted = flat * w.reshape(-1, 1)
            hessian += weighted.T @ flat
            gradient += weighted.T @ r.ravel()
        return gradient, hessian

    def _costs(self, values: FloatArray, weights: Sequence[FloatArray]) -> FloatArray:
        return self._cost_of(values, self.residuals(values), weights)

    def _cost_of(
        self, values: FloatArray, residual: Sequence[FloatArray], weights: Sequence[FloatArray]
    ) -> FloatArray:
        values = np.atleast_2d(values)
        total = (values[:, :-1] - self._centre) ** 2 @ self._information
        for r, w in zip(residual, weights, strict=True):
            total = total + np.sum(w * r**2, axis=(1, 2, 3))
        return np.where(np.isfinite(total), total, np.inf)


def _correlation_samples(residual: Sequence[FloatArray], longest: int) -> float:
    """Return one plus twice the sum of the residuals' correlations up to their first zero, at least 1."""
    longest = min(longest, max(r.shape[1] for r in residual) - 1)
    total = sum(float(np.sum(r**2)) for r in residual)
    worth, count = 1.0, sum(r.size for r in residual)
    for lag in range(1, longest + 1):
        product, pairs = 0.0, 0
        for r in residual:
            product += float(np.sum(r[:, lag:] * r[:, :-lag]))
            pairs += r[:, lag:].size
        correlation = product / max(pairs, 1) / max(total / max(count, 1), 1e-300)
        if correlation <= 0:
            break
        worth += 2 * correlation
    return worth
