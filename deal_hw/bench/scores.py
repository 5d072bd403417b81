"""Scores of a calibration against a truth that only a bench knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calibration import Z90
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

ROUNDING = 1e-9
"""Part of a range by which a truth may lie outside it: a draw passes through logarithms."""


def outside_range(space: ParameterSpace, truth: Mapping[str, float]) -> str:
    """Return why no search of this space can find the truth, or "".

    Args:
        space: The searched parameters and their ranges.
        truth: True values by name; names that are not searched are not read.
    """
    for p in space:
        value = truth.get(p.name, p.nominal)
        slack = ROUNDING * (p.high - p.low)
        if not p.low - slack <= value <= p.high + slack:
            return (
                f"the true {p.name}, {value:.4g} {p.unit}, lies outside its search range, {p.low:.4g} to "
                f"{p.high:.4g}, so no search can find it; use the parameter set (--space) from which the "
                "truth is drawn, or a larger --range-ratio"
            )
    return ""


def check_truth(space: ParameterSpace, truth: Mapping[str, float]) -> None:
    """Raise `ConfigurationError` where a truth lies outside its range; see :func:`outside_range`."""
    if why := outside_range(space, truth):
        raise ConfigurationError(why)


def error_percent(theta: FloatArray, truth: FloatArray) -> float:
    """Return the mean over parameters of |p - p*| / p* in percent (DEAL, eq. 11)."""
    return float(100.0 * np.mean(np.abs(theta - truth) / truth))


def log_error_x100(theta: FloatArray, truth: FloatArray) -> float:
    """Return 100 times the mean |ln(p / p*)|, which is symmetric around the truth."""
    return float(100.0 * np.mean(np.abs(np.log(theta / truth))))


def interval_score(
    space: ParameterSpace, interval: FloatArray, truth: FloatArray, bound_std: FloatArray
) -> tuple[float, float]:
    """Score 90 % intervals, (K, 2).

    Args:
        space: The parameters.
        interval: The intervals, (K, 2).
        truth: True parameters, (K,).
        bound_std: The Fisher bound's standard deviations, (K,).

    Returns:
        Share of the parameters whose interval holds the truth, and the median interval width over that of the
        Fisher bound.
    """
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    width = space.to_scale(interval[:, 1]) - space.to_scale(interval[:, 0])
    return float(np.mean(inside)), float(np.median(width / (2 * Z90 * bound_std)))


def fisher_std(
    problem: Problem,
    theta: FloatArray,
    latency_s: float,
    states: Sequence[tuple[FloatArray, FloatArray]],
    noise_std: FloatArray,
    length: int,
) -> FloatArray:
    """Return the standard deviations of the Fisher bound at the truth, in each parameter's own scale, (K,).

    The bound has the same windows, unknowns (start states and latency) and range prior as the intervals, but
    the true noise.

    Args:
        problem: The recordings and the simulator.
        theta: True parameters, (K,).
        latency_s: True latency [s].
        states: True positions and velocities at the samples of each episode, (T, J) each.
        noise_std: True standard deviation of the measured channels, (M,).
        length: Samples of a window.
    """
    shooting = Shooting(problem, length)
    hessian = shooting.normal(shooting.start(theta, latency_s, list(states))).hessian
    # The problem whitens by estimated noise, the bound uses the true noise.
    estimated = problem.noise_std[problem.channels]
    ratio = float(np.mean((estimated / np.maximum(noise_std, estimated * 1e-3)) ** 2))
    low, high = problem.latency_range_s
    prior = np.append(problem.space.width**2, (high - low) ** 2) / 12.0
    covariance = np.linalg.inv(hessian * ratio + np.diag(1.0 / prior))
    return np.asarray(np.sqrt(np.diag(covariance))[:-1])
