"""Channels whose sensors are finer than the model: weighted by the model's residual, not by sensor noise.

An encoder without noise, with 25 um a count, measures motion that no model of a robot predicts. Weighted by
its noise, it dominates the other channels. Parameters that only those channels show are then biased.
Maximum likelihood with unknown variances, as in output-error fits of aircraft, weights each channel by its
residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deal_hw.calib.data.noise import FLOOR_STD, Mask
from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import EXPLAINED, STAGES_S, Refined, refine
from deal_hw.calib.fit.solver import channel_scale
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

FINEST_MODEL = 0.002
"""A smaller residual, as a share of the channel's motion within a window (root mean square), is taken for
the model's limit: no search finds better parameters [-]. The noise of usual encoders is above it: 0.3 mm
on a cart that moves 20 mm in a window is 1.5 %."""

LEAST_NOISE = 10.0
"""With all noise below this multiple of the wire's rounding, the recording is from a simulator, whose
model may be exact [-]."""

ROUNDS = 2
"""Fits with new weights for each window length."""

ADDS_UP = 2.0
"""A longer window is kept while no channel's residual grows by more than this factor [-]. An error of the
model adds up over time; that of a wrong start state grows faster."""


@dataclass(frozen=True, slots=True)
class WeightedFit:
    """A fit with new weights of the channels.

    Attributes:
        problem: The problem with these weights.
        fit: Its fit; chi2 is near 1.
        scale: Standard deviation used for each channel, as a multiple of its noise, (M,).
    """

    problem: Problem
    fit: Refined
    scale: FloatArray

    @property
    def chi2(self) -> float:
        """Mean squared residual over the sensors' noise."""
        return float(np.mean((self.scale * _rms(self.fit)) ** 2))


def weight_channels(problem: Problem, fit: Refined) -> WeightedFit | None:
    """Return the fit with channels weighted by their residual, in growing windows; None if it does not apply.

    Args:
        problem: The problem.
        fit: A fit whose residual is above the noise.
    """
    noisy = np.any(problem.noise.position_std > LEAST_NOISE * FLOOR_STD)
    if problem.known_std is not None or problem.robot.base is not None or not noisy:
        return None
    left = _rms(fit)
    fine = _followed(fit, left)
    if fine.all() or not np.any(left[fine] ** 2 > EXPLAINED):
        return None
    scale, weighted = np.where(fine, np.maximum(left, 1.0), 1.0), None
    for seconds in STAGES_S:
        if samples_in(problem, seconds) < fit.shooting.length:
            continue
        try:
            longer = _fitted(problem, fit if weighted is None else weighted.fit, scale, fine, seconds)
        except InsufficientDataError:
            break
        # The other channels keep the weight of their noise. The fit has to explain them to that level.
        if np.any(_rms(longer.fit)[~fine] ** 2 > EXPLAINED):
            break
        if weighted is not None and np.any(longer.scale > ADDS_UP * weighted.scale):
            break
        shorter = None if weighted is None else weighted.fit
        weighted = replace(longer, fit=replace(longer.fit, shorter=shorter))
        scale = longer.scale
    return weighted


def _fitted(problem: Problem, fit: Refined, scale: FloatArray, fine: Mask, seconds: float) -> WeightedFit:
    """Return the fit in windows of one length; weights and parameters are fitted in turn."""
    for _ in range(ROUNDS):
        weighted = problem.with_noise(scale)
        states = fit.shooting.states(fit.point)
        fit = refine(weighted, fit.theta, fit.latency_s, (seconds,), states=states)
        found = WeightedFit(weighted, fit, scale)
        scale = np.where(fine, np.maximum(scale * _rms(fit), 1.0), 1.0)
    return found


def _rms(fit: Refined) -> FloatArray:
    """Return the root mean square of each channel's whitened residual, (M,)."""
    reported = [d.reported for d in fit.shooting.data]
    return channel_scale(fit.shooting.residuals(fit.point), reported, robust=False)


def _followed(fit: Refined, left: FloatArray) -> Mask:
    """Return which channels have a residual at the model's limit, (M,)."""
    data = fit.shooting.data
    moved = np.concatenate([(d.measured - d.measured[:, :1]).reshape(-1, len(left)) for d in data])
    noise = fit.shooting.problem.noise.position_std
    return np.asarray(left * noise < FINEST_MODEL * np.sqrt(np.mean(moved**2, axis=0)))
