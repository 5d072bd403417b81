"""How noisy a recorded channel is, estimated from the recording alone."""

from __future__ import annotations

import math

import numpy as np

from deal_hw.types import FloatArray

_ORDER = 6
_MAD_TO_STD = 1.4826022185056018


def white_noise_std(values: FloatArray, floor: float) -> FloatArray:
    """Estimate the standard deviation of white noise on top of smooth motion.

    The sixth difference of a smooth motion nearly vanishes while white noise of variance s^2 comes out with variance
    924 s^2 (the sum of the squared binomial coefficients); the median keeps impacts and stick-slip out.

    Args:
        values: Uniformly sampled channels, (T, J).
        floor: Smallest value returned, such as the wire's resolution over sqrt(12).

    Returns:
        Standard deviations, (J,).
    """
    if len(values) <= 2 * _ORDER:
        return np.full(values.shape[1], floor)
    difference = np.diff(values, n=_ORDER, axis=0)
    gain = math.sqrt(math.comb(2 * _ORDER, _ORDER))
    spread = _MAD_TO_STD * np.median(np.abs(difference - np.median(difference, axis=0)), axis=0)
    return np.asarray(np.maximum(spread / gain, floor))
