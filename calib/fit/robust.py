"""A loss that a few wild residuals do not rule: Huber's, by weights that are computed anew a few times."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished, polish_windows
from deal_hw.calib.fit.residual import Shooting
from deal_hw.types import FloatArray

HUBER = 1.345
"""Residuals beyond this many standard deviations weigh less; 95 % as efficient as least squares on noise."""

ROUNDS = 3
ITERATIONS = 4
HEAVY_TAILS = 6.0
"""Kurtosis (noise: 3) from which the robust polish is worth a trial."""

_MAD_TO_STD = 1.4826022185056018


def huber_weights(residual: FloatArray) -> FloatArray:
    """Return the weight of each whitened residual, like its shape; 1 for all but the large ones.

    Their spread is measured by the median, at least that of the noise: a residual is not wild for being
    small noise in a model that explains nothing.
    """
    size = np.abs(residual)
    spread = max(_MAD_TO_STD * float(np.median(size)), 1.0)
    return np.asarray(np.minimum(1.0, HUBER * spread / np.maximum(size, 1e-300)))


def kurtosis(residuals: Sequence[FloatArray]) -> float:
    """Return the fourth moment over the squared second; 3 for noise."""
    values = np.concatenate([r.ravel() for r in residuals])
    return float(np.mean(values**4) / max(float(np.mean(values**2)) ** 2, 1e-300))


def robust_polish(problem: Problem, polished: Polished, fixed_latency: bool) -> Polished:
    """Polish on from where a polish ended, large residuals weighing less.

    The windows' standard deviations are divided by the weights' roots, so that normal equations, intervals
    and start states all see the same weights. ``chi2`` stays that of all residuals alike, or the loss would
    hide that the model is wrong.

    Args:
        problem: The problem.
        polished: Where to start; its windows are kept.
        fixed_latency: Keep the latency.
    """
    plain, point, normal, iterations = polished.shooting, polished.point, polished.normal, polished.iterations
    found = polished
    ratio = [np.ones_like(d.std) for d in plain.data]
    for _ in range(ROUNDS):
        # Residuals are whitened with the last weights in them.
        raw = [r / np.sqrt(w) for r, w in zip(normal.residual, ratio, strict=True)]
        ratio = [huber_weights(r) for r in raw]
        data = [
            dataclasses.replace(d, std=d.std / np.sqrt(w)) for d, w in zip(plain.data, ratio, strict=True)
        ]
        shooting = Shooting(problem, plain.length, data=data)
        found = polish_windows(shooting, point, ITERATIONS, fixed_latency)
        point, normal, iterations = found.point, found.normal, iterations + found.iterations
    free = len(problem.space) + (0 if fixed_latency else 1)
    chi2 = float(plain.costs([point])[0]) / max(normal.count - free, 1)
    return dataclasses.replace(found, chi2=chi2, iterations=iterations)
