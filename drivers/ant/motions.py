"""Motions that excite the ant: it has no balance to keep, so torques alone will do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from deal_hw.drivers.ant.description import JOINTS
from deal_hw.types import FloatArray

BAND_HZ = (0.3, 2.5)
AMPLITUDE = 0.9
_TONES = 3


def flail(
    rng: np.random.Generator, band_hz: tuple[float, float] = BAND_HZ
) -> Callable[[FloatArray, FloatArray, float], FloatArray]:
    """Return a behaviour that drives all motors with sums of sines, which makes the ant hop and slide.

    Args:
        rng: Draws frequencies and phases.
        band_hz: Lowest and highest frequency [Hz].
    """
    low, high = band_hz
    count = len(JOINTS)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (count, _TONES)))
    phase = rng.uniform(0.0, 2 * np.pi, (count, _TONES))

    def behaviour(position: FloatArray, velocity: FloatArray, at_s: float) -> FloatArray:
        wave = np.sin(2 * np.pi * frequency * at_s + phase).sum(axis=1)
        return np.asarray(np.clip(AMPLITUDE * wave, -1.0, 1.0))

    return behaviour
