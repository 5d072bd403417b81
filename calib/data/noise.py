"""How noisy a recording is, estimated from the recording alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from deal_hw.types import FloatArray

_ORDER = 6
_GAIN = math.sqrt(math.comb(2 * _ORDER, _ORDER))
_MAD_TO_STD = 1.4826022185056018
_BINS = 10
_FEWEST_IN_BIN = 20
_CERTAIN = 2.0
"""A timing jitter counts where it explains this many standard errors of the noise's growth with speed."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """White noise on positions, and samples whose time is uncertain.

    A sample that reports the state of a slightly other moment is off by speed times time, so a jittering
    sensor looks noisier the faster the joint moves.

    Attributes:
        position_std: Noise of positions at rest, (J,) [m or rad].
        timing_std_s: Standard deviation of the samples' time [s].
    """

    position_std: FloatArray
    timing_std_s: float

    def std(self, velocity: FloatArray) -> FloatArray:
        """Return the standard deviation of positions reported at these velocities, (..., J)."""
        return np.sqrt(self.position_std**2 + (self.timing_std_s * velocity) ** 2)


def white_noise_std(values: FloatArray, floor: float) -> FloatArray:
    """Estimate the standard deviation of white noise on top of smooth motion.

    The sixth difference of a smooth motion nearly vanishes while white noise of variance s^2 comes out with
    variance 924 s^2 (the sum of the squared binomial coefficients); the median keeps impacts and stick-slip
    out.

    Args:
        values: Uniformly sampled channels, (T, J).
        floor: Smallest value returned, such as the wire's resolution over sqrt(12).

    Returns:
        Standard deviations, (J,).
    """
    if len(values) <= 2 * _ORDER:
        return np.full(values.shape[1], floor)
    return np.maximum(_spread(np.diff(values, n=_ORDER, axis=0)), floor)


def _spread(difference: FloatArray) -> FloatArray:
    centred = np.abs(difference - np.median(difference, axis=0))
    return np.asarray(_MAD_TO_STD * np.median(centred, axis=0) / _GAIN)


def noise_model(positions: list[FloatArray], velocities: list[FloatArray], floor: float) -> NoiseModel:
    """Estimate noise and timing jitter of recordings.

    The noise is estimated in bins of equal speed, joint by joint, and its square fitted by a straight line in
    the squared speed: the intercept is the noise at rest, the slope, which all joints share, the jitter's
    variance.

    Args:
        positions: Reported positions of each recording, (T, J) each, uniformly sampled.
        velocities: Smoothed velocities, likewise.
        floor: Smallest noise.
    """
    J = positions[0].shape[1]
    whole = np.max([white_noise_std(x, floor) for x in positions], axis=0)
    usable = [i for i, x in enumerate(positions) if len(x) > _BINS * _FEWEST_IN_BIN]
    if not usable or np.all(whole <= 10 * floor):
        return NoiseModel(whole, 0.0)
    difference = np.concatenate([np.diff(positions[i], n=_ORDER, axis=0) for i in usable])
    middle = _ORDER // 2
    speed2 = np.concatenate(
        [velocities[i][middle : middle + len(velocities[i]) - _ORDER] ** 2 for i in usable]
    )
    slopes, weights = [], []
    lines: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for j in range(J):
        order = np.argsort(speed2[:, j])
        parts = np.array_split(order, _BINS)
        x = np.array([speed2[part, j].mean() for part in parts])
        y = np.array([float(_spread(difference[part, j : j + 1])[0]) ** 2 for part in parts])
        # A variance from n samples through a median is known to about 2.3 / sqrt(n); neighbours share
        # differences.
        sigma = y * 2.3 * math.sqrt(3.0 / len(parts[0])) + floor**2
        slope, error = _slope(x, y, sigma)
        slopes.append(slope)
        weights.append(1.0 / error**2)
        lines.append((x, y, sigma))
    variance = float(np.average(slopes, weights=weights))
    error = float(1.0 / math.sqrt(sum(weights)))
    if variance < _CERTAIN * error:
        return NoiseModel(whole, 0.0)
    rest = [max(float(np.average(y - variance * x, weights=1 / s**2)), floor**2) for x, y, s in lines]
    return NoiseModel(np.sqrt(rest), math.sqrt(variance))


def _slope(x: FloatArray, y: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Return the slope of a weighted line and its standard error."""
    w = 1.0 / sigma**2
    mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
    spread = float(np.sum(w * (x - mean_x) ** 2))
    if spread <= 0:
        return 0.0, math.inf
    return float(np.sum(w * (x - mean_x) * (y - mean_y)) / spread), 1.0 / math.sqrt(spread)
