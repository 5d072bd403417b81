"""Output-error fit: least squares on long predictions from smoothed states, as held-out motion is judged.

Multiple shooting fits the start state of every window. Where the model is incomplete (backlash, a friction
law, a drifting clock), those start states absorb the model error. A damped robot forgets its start state
within seconds, so long windows need no fit of it. The cost is then what a user wants small: the error of a
prediction. The scale of each channel is its own residual, estimated together with the parameters, so nobody
has to state how good the model is. Residuals of a wrong model are autocorrelated: their number is divided by
the correlation time. The search range serves as prior for the rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deal_hw.calib.data.noise import rows_by_value
from deal_hw.calib.data.parts import longest_windows
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.residual import Normal, Point, Shooting
from deal_hw.calib.fit.solver import (
    SolverSettings,
    channel_scale,
    correlated_samples,
    huber_weights,
    solve_parameters,
)
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Settings of :func:`fit_output_error`.

    Attributes:
        seconds: Length of the windows [s]; shorter where no stretch is so long.
        latency: Fit the latency; otherwise it stays at its start.
        prior_std: Standard deviation of parameters around their nominal values, as a share of their range in
            its own scale; infinite for none. The default is that of a uniform distribution over the range.
        robust: Large residuals weigh less (Huber).
        iterations: Most derivatives. Each serves up to ``SECANTS`` more steps.
        derivatives: Derivatives between two estimates of the residual scale.
        converged: Relative decrease of the cost between two estimates below which the fit ends: held-out
            motion does not show it.
        reach: See :class:`deal_hw.calib.fit.solver.SolverSettings`.
        longest_lag_s: Longest lag of the residuals' autocorrelation [s].
    """

    seconds: float = 2.0
    latency: bool = True
    prior_std: float = 0.289
    robust: bool = False
    iterations: int = 24
    derivatives: int = 2
    converged: float = 2e-3
    reach: float = 30.0
    longest_lag_s: float = 1.0


SECANTS = 3
"""Most steps that follow a derivative by Broyden's updates. A derivative costs as many simulations as there
are parameters, a step one. On the real SO-101 fits need half the derivatives then, for residuals that are
0.05 % larger at most (`converged` allows more)."""

SHORT = Recipe(seconds=0.2)
"""Windows in which even a distant start does not diverge."""


@dataclass(frozen=True)
class OutputErrorFit:
    """Result of an output-error fit.

    Attributes:
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        recipe: The settings.
        scale: Scale of each channel's residuals, (M,): the root mean square; for a robust loss at most the
            scaled median.
        iterations: Derivatives used.
        plain: The windows, with the sensors' noise.
        weighed: The windows, with ``scale``. An uncertainty counts the residuals' correlation itself.
        point: The solver's point.
        central: Whether predictions are linearised by central differences, which an uncertainty needs.
    """

    theta: FloatArray
    latency_s: float
    recipe: Recipe
    scale: FloatArray
    iterations: int
    plain: Shooting
    weighed: Shooting
    point: Point
    central: bool

    @property
    def member(self) -> Member:
        """Parameters and latency, as a candidate among others."""
        return self.theta, self.latency_s

    @property
    def chi2(self) -> float:
        """Mean squared ratio of the residuals' scale to the sensors' noise, timing included."""
        problem = self.plain.problem
        return float(np.mean((self.scale / problem.noise_std[problem.channels]) ** 2))

    @property
    def expected_std(self) -> FloatArray:
        """Expected prediction error, positions then velocities, (2 C,): the residual, and at least the noise.

        A search needs it as scale where nobody knows how good the model is.
        """
        problem = self.plain.problem
        std = problem.noise_std.copy()
        std[problem.channels] = np.maximum(std[problem.channels], self.scale)
        return std

    @cached_property
    def normal(self) -> Normal:
        """Normal equations of weighted residuals and of the parameters' own priors, with their rows.

        They are zero for a fixed latency. The residuals are divided by ``scale``.
        """
        normal = self.weighed.normal(self.point, keep=True, central=self.central)
        free = np.append(np.ones(len(self.theta)), 0.0 if self.plain.fixed_latency else 1.0)
        left = zip(self.plain.data, self.plain.residuals(self.point), strict=True)
        return dataclasses.replace(
            normal,
            hessian=normal.hessian * np.outer(free, free),
            gradient=normal.gradient * free,
            rows=tuple(dataclasses.replace(r, parameter=r.parameter * free) for r in normal.rows),
            residual=tuple(_errors(d, r) / self.scale for d, r in left),
        )


def fit_output_error(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    recipe: Recipe,
    *,
    iterations: int | None = None,
    central: bool = False,
) -> OutputErrorFit:
    """Fit from a start, (K,) and latency [s].

    There are at most ``iterations`` derivatives, the recipe's by default; 0 stays at the start. For
    ``central`` see :class:`OutputErrorFit`.

    Raises:
        InsufficientDataError: No recording holds a window.
    """
    # Its own weights are those of a model error, whatever that is.
    problem = problem.with_command_delays(None)
    space = problem.space
    fixed = not recipe.latency or problem.fixed_latency_s is not None
    if problem.fixed_latency_s is None:
        latency_s = float(np.clip(latency_s, *problem.latency_range_s))
    windows = longest_windows(problem, recipe.seconds)
    # Short recordings have shorter windows.
    lengths_s = [data.windows.length * problem.episodes[data.episode].period_s for data in windows]
    length, share = round(max(lengths_s) / problem.period_s), recipe.prior_std
    plain = Shooting(problem, length, windows, given=True, prior_share=share, fixed_latency=fixed)
    point = plain.start(np.clip(theta, space.low, space.high), latency_s)
    left = recipe.iterations if iterations is None else iterations
    used = 0
    while left > 0:
        # The scale is estimated again every few steps: nobody has stated how good the model is.
        weighed, _ = _weighed(plain, point, recipe)
        before = weighed.cost(point)
        # The prior holds insensitive parameters. Autocorrelated residuals weigh too little for one more hold.
        solver = SolverSettings(
            iterations=min(recipe.derivatives, left),
            converged=recipe.converged,
            reach=recipe.reach,
            secants=SECANTS,
        )
        point, more = solve_parameters(weighed, point, solver)
        left, used = left - max(more, 1), used + more
        if not before - weighed.cost(point) > recipe.converged * before:
            break
    weighed, scale = _weighed(plain, point, recipe, prior_share=np.inf, correlated=False)
    return OutputErrorFit(
        plain.theta(point), float(point.value[-1]), recipe, scale, used, plain, weighed, point, central
    )


def prediction_rmse(problem: Problem, members: Sequence[Member], seconds: float) -> FloatArray:
    """Return the root mean square errors of predictions from smoothed states, (N, M).

    Windows last ``seconds``.
    """
    squares, count = np.zeros((len(members), len(problem.channels))), np.zeros(len(problem.channels))
    for data, error in prediction_errors(problem, members, seconds):
        squares += np.sum(np.where(data.reported, error, 0.0) ** 2, axis=(1, 2))
        count += np.sum(data.reported, axis=(0, 1))
    return np.asarray(np.sqrt(np.where(np.isfinite(squares), squares, np.inf) / np.maximum(count, 1)))


def standing_rmse(problem: Problem, seconds: float) -> FloatArray:
    """Return the same errors, (M,), of a robot whose state stays as it is at the start of each window."""
    squares, count = np.zeros(len(problem.channels)), np.zeros(len(problem.channels))
    for data in longest_windows(problem, seconds):
        # A robot that stays as it is has an effort of 0 here.
        still = np.zeros((len(data.windows), len(problem.efforts)))
        start = np.concatenate([data.start_position, data.start_velocity, still], axis=1)
        start = start[:, None, problem.channels]
        squares += np.sum(np.where(data.reported, start - data.measured, 0.0) ** 2, axis=(0, 1))
        count += np.sum(data.reported, axis=(0, 1))
    return np.asarray(np.sqrt(squares / np.maximum(count, 1)))


def _errors(data: WindowData, residual: FloatArray) -> FloatArray:
    """Return prediction minus measurement, (W, H, M), from whitened residuals; 0 for missing samples."""
    return np.asarray(np.nan_to_num(residual) * np.where(data.reported, data.std, 0.0))


def _weighed(
    plain: Shooting,
    point: Point,
    recipe: Recipe,
    *,
    prior_share: float | None = None,
    correlated: bool = True,
) -> tuple[Shooting, FloatArray]:
    """Return the fit with each channel scaled by its own residual, and these scales, (M,).

    With ``correlated``, standard deviations grow with the residuals' correlation time.
    """
    problem = plain.problem
    errors = [_errors(d, r) for d, r in zip(plain.data, plain.residuals(point), strict=True)]
    seen = [d.reported for d in plain.data]
    scale = channel_scale(errors, seen, recipe.robust)
    correlations = np.ones(len(errors))
    periods_s = [problem.episodes[d.episode].period_s for d in plain.data]
    for rows in rows_by_value(periods_s) if correlated else ():
        longest = round(recipe.longest_lag_s / periods_s[rows[0]])
        correlations[rows] = correlated_samples([errors[e] / scale for e in rows], longest)
    data = []
    for d, error, reported, correlation in zip(plain.data, errors, seen, correlations, strict=True):
        weight = huber_weights(error / scale) if recipe.robust else np.ones_like(error)
        std = np.where(reported, scale * np.sqrt(correlation / weight), np.inf)
        data.append(dataclasses.replace(d, std=std))
    return plain.on(data, prior_share=prior_share), scale


def prediction_errors(
    problem: Problem, members: Sequence[Member], seconds: float
) -> Iterator[tuple[WindowData, FloatArray]]:
    """Yield windows as :func:`longest_windows` and the errors of predictions from smoothed states there.

    Errors are (N, W, H, M) for N members.
    """
    theta, latency = np.stack([m[0] for m in members]), np.array([m[1] for m in members])
    for data in longest_windows(problem, seconds):
        yield data, problem.predict(theta, latency, data).observed - data.measured
