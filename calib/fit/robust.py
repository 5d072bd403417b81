"""Weights with which a few wild residuals do not rule a fit, and what measures residuals of a wrong model."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from deal_hw.calib.data.problem import WindowData
from deal_hw.types import FloatArray

HUBER = 1.345
"""Residuals beyond this many standard deviations weigh less; 95 % as efficient as least squares on noise."""

HEAVY_TAILS = 6.0
"""Kurtosis (noise: 3) from which the robust polish is worth a trial."""

MAD_TO_STD = 1.4826022185056018
"""Standard deviation of normal noise over the median of its absolute values."""

LEAST_SCALE = 1e-9
"""Residuals of a noise-free recording that the model explains are rounding [rad or m]."""


def huber_weights(residual: FloatArray) -> FloatArray:
    """Return the weight of each whitened residual, like its shape; 1 for all but the large ones.

    Their spread is measured by the median, at least that of the noise: a residual is not wild for being
    small noise in a model that explains nothing.
    """
    size = np.abs(residual)
    spread = max(MAD_TO_STD * float(np.median(size)), 1.0)
    return np.asarray(np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-300)))


def cauchy_windows(data: Sequence[WindowData], residuals: Sequence[FloatArray]) -> list[WindowData]:
    """Return windows that weigh less the more their residual exceeds the median's (Cauchy's weights).

    Args:
        data: The windows of each episode.
        residuals: Their whitened residuals, (W, H, M) each.
    """
    costs = [np.sum(r**2, axis=(1, 2)) for r in residuals]
    median = max(float(np.median(np.concatenate(costs))), 1e-12)
    return [
        dataclasses.replace(d, std=d.std * np.sqrt(1.0 + c / median)[:, None, None])
        for d, c in zip(data, costs, strict=True)
    ]


def kurtosis(residuals: Sequence[FloatArray]) -> float:
    """Return the fourth moment over the squared second; 3 for noise."""
    values = np.concatenate([r.ravel() for r in residuals])
    return float(np.mean(values**4) / max(float(np.mean(values**2)) ** 2, 1e-300))


def channel_scale(errors: Sequence[FloatArray], seen: Sequence[np.ndarray], robust: bool) -> FloatArray:
    """Return what measures each channel's errors where no sensor's noise does, (M,).

    Args:
        errors: Prediction minus measurement of each episode, (W, H, M).
        seen: Whether each was reported, likewise.
        robust: Measure by the median, or a channel that fails somewhere counts nowhere.
    """
    squares = np.sum(
        [np.sum(np.where(s, r, 0.0) ** 2, axis=(0, 1)) for r, s in zip(errors, seen, strict=True)], axis=0
    )
    counts = np.sum([np.sum(s, axis=(0, 1)) for s in seen], axis=0)
    scale = np.sqrt(squares / np.maximum(counts, 1))
    if robust:
        size = np.concatenate([np.abs(r).reshape(-1, r.shape[-1]) for r in errors])
        scale = np.minimum(scale, MAD_TO_STD * np.median(size, axis=0))
    return np.asarray(np.maximum(scale, LEAST_SCALE))


def correlated_samples(residuals: Sequence[FloatArray], longest: int) -> float:
    """Return one plus twice the sum of the residuals' correlations up to their first zero, at least 1.

    Args:
        residuals: Whitened residuals of each episode, (W, H, M).
        longest: Longest lag that is looked at [samples].
    """
    longest = min(longest, max(r.shape[1] for r in residuals) - 1)
    total = sum(float(np.sum(r**2)) for r in residuals)
    worth, count = 1.0, sum(r.size for r in residuals)
    for lag in range(1, longest + 1):
        product, pairs = 0.0, 0
        for r in residuals:
            product += float(np.sum(r[:, lag:] * r[:, :-lag]))
            pairs += r[:, lag:].size
        correlation = product / max(pairs, 1) / max(total / max(count, 1), 1e-300)
        if correlation <= 0:
            break
        worth += 2 * correlation
    return worth
