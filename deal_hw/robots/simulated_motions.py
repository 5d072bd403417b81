"""Motions that excite robots which exist in simulators only and have no balance to keep."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from deal_hw.description import RobotDescription
from deal_hw.types import FloatArray

BAND_HZ: Final = (0.3, 2.5)
FAST_HZ: Final = (1.5, 4.0)
AMPLITUDE: Final = 0.9
"""Share of a motor's torque."""
SWING_RAD: Final = 0.2
"""Swing of a servo's target about the default pose [rad]."""
_TONES: Final = 3


def flail(
    rng: np.random.Generator, description: RobotDescription, band_hz: tuple[float, float] = BAND_HZ
) -> Callable[[FloatArray, FloatArray, float], FloatArray]:
    """Return a behaviour that drives all actuators with sums of sines, which makes an ant hop and slide.

    Args:
        rng: Draws frequencies and phases.
        description: The robot; targets of servos stay within its limits.
        band_hz: Lowest and highest frequency [Hz].
    """
    low, high = band_hz
    count = len(description.actuated)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (count, _TONES)))
    phase = rng.uniform(0.0, 2 * np.pi, (count, _TONES))
    rest, swing = np.zeros(count), AMPLITUDE
    if description.actuation == "position":
        rest = np.array(description.default_position)[list(description.actuated_index)]
        swing = SWING_RAD
    least, most = np.array(description.limits.target).T

    def behaviour(position: FloatArray, velocity: FloatArray, at_s: float) -> FloatArray:
        wave = np.sin(2 * np.pi * frequency * at_s + phase).sum(axis=1)
        return np.asarray(np.clip(rest + swing * wave, least, most))

    return behaviour
