"""Channels whose sensors are finer than the model: weighed by what the model leaves, not by their noise.

An encoder without noise, of 25 um a count, sees what no model of a robot predicts. Weighed by its noise it
drowns the other channels, and parameters that only they tell are bent to its last micrometres. Maximum
likelihood with unknown variances, as in output-error fits of aircraft, weighs each channel by its residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.calib.data.noise import Mask
from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.calib.fit.refinement import SETTINGS as REFINEMENT
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    from deal_hw.calib.fit.residual import Shooting


@dataclass(frozen=True, slots=True, kw_only=True)
class WeightSettings:
    """When channels are weighed by their residual.

    Attributes:
        finest_model: A residual below this share of what its channel moves within a window (root mean
            square) is the model's: no search would find parameters that leave less [-]. Usual encoders' noise
            is above it: 0.3 mm on a cart that moves 20 mm in a window are 1.5 %.
        least_noise: Where all noise is below so many times the wire's rounding, the recording is of a
            simulator, whose model may be exact [-].
        rounds: Fits and new weights of each window length.
        adds_up: A longer window is kept while no channel's residual grows by more than this factor: what a
            model lacks adds up over time, and a wrong start state does so faster.
    """

    finest_model: float = 0.002
    least_noise: float = 10.0
    rounds: int = 2
    adds_up: float = 2.0


SETTINGS = WeightSettings()


@dataclass(frozen=True, slots=True)
class Weighed:
    """A problem with its channels weighed anew.

    Attributes:
        problem: The problem.
        fit: The fit there; its chi2 is near 1.
        scale: What stands for each channel's noise, over the noise, (M,).
    """

    problem: Problem
    fit: Refined
    scale: FloatArray

    @property
    def chi2(self) -> float:
        """Mean squared residual over the sensors' noise."""
        return float(np.mean((self.scale * _rms(self.fit.shooting, self.fit)) ** 2))


def weigh_channels(problem: Problem, fit: Refined) -> Weighed | None:
    """Weigh channels by what a fit leaves of them, in growing windows; None where that is not the trouble.

    Args:
        problem: The problem.
        fit: A fit that leaves more than noise.
    """
    noisy = np.any(problem.noise.position_std > SETTINGS.least_noise * problem.settings.floor)
    if problem.known_std is not None or problem.robot.base is not None or not noisy:
        return None
    left = _rms(fit.shooting, fit)
    fine = _followed(fit.shooting, left)
    if fine.all() or not np.any(left[fine] ** 2 > REFINEMENT.explained):
        return None
    scale, weighed = np.where(fine, np.maximum(left, 1.0), 1.0), None
    for seconds in REFINEMENT.stages_s:
        if samples_in(problem, seconds) < fit.shooting.length:
            continue
        try:
            longer = _fitted(problem, fit if weighed is None else weighed.fit, scale, fine, seconds)
        except InsufficientDataError:
            break
        # The others have their noise's weight, and have to be explained to it.
        if np.any(_rms(longer.fit.shooting, longer.fit)[~fine] ** 2 > REFINEMENT.explained):
            break
        if weighed is not None and np.any(longer.scale > SETTINGS.adds_up * weighed.scale):
            break
        weighed, scale = longer, longer.scale
    return weighed


def _fitted(problem: Problem, fit: Refined, scale: FloatArray, fine: Mask, seconds: float) -> Weighed:
    """Return the fit in windows of one length, weights and parameters in turn."""
    for _ in range(SETTINGS.rounds):
        weighed = problem.with_noise(scale)
        fit = refine(
            weighed,
            fit.theta,
            fit.latency_s,
            (seconds,),
            fixed_latency=problem.fixed_latency_s is not None,
            states=fit.shooting.states(fit.point),
        )
        found = Weighed(weighed, fit, scale)
        scale = np.where(fine, np.maximum(scale * _rms(fit.shooting, fit), 1.0), 1.0)
    return found


def _rms(shooting: Shooting, fit: Refined) -> FloatArray:
    """Return the root mean square of each channel's whitened residual, (M,)."""
    squared = np.concatenate([r.reshape(-1, r.shape[-1]) for r in shooting.residuals(fit.point)]) ** 2
    reported = np.concatenate([np.isfinite(d.std).reshape(-1, d.std.shape[-1]) for d in shooting.data])
    return np.asarray(np.sqrt(squared.sum(axis=0) / np.maximum(reported.sum(axis=0), 1)))


def _followed(shooting: Shooting, left: FloatArray) -> Mask:
    """Return which channels a fit follows as closely as a model can, (M,)."""
    moved = np.concatenate([(d.measured - d.measured[:, :1]).reshape(-1, len(left)) for d in shooting.data])
    noise = shooting.problem.noise.position_std
    return np.asarray(left * noise < SETTINGS.finest_model * np.sqrt(np.mean(moved**2, axis=0)))
