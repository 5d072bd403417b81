"""Velocity of a base from its accelerometer and its standing feet; numpy only.

A standing foot gives the velocity of the base. Feet of a trot slide when they land and take off, and
accelerometers drift: the filter combines both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray

GRAVITY: Final = np.array([0.0, 0.0, 9.81])
"""Reading of an accelerometer at rest, in the world [m/s²]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterSettings:
    """Weights of feet and accelerometer; chosen on six emulated Go2 of profile `realistic`.

    Attributes:
        drift: Standard deviation that integrated accelerations gain in a second [m/s].
        foot_m_s: Standard deviation of a standing foot's velocity [m/s].
        gate: Deviation above which a foot slides or lands and weighs less [standard deviations].
        start_m_s: Standard deviation of the first velocity [m/s].
        share: Load below which a foot swings, as a share of the largest load.
        borne: Total load below which no foot stands, as a share of the weight: the swing of legs looks like a
            third of it.
        lift_drift: The same as ``drift``, upwards, where the height corrects it
            (:func:`deal_hw.sim.legged.leg_odometry.smoothed_height`) [m/s].
        height_m: Standard deviation of the height over the standing feet in one sample [m]. It is larger than
            the error, because the errors of one stance are alike.
    """

    drift: float = 0.5
    foot_m_s: float = 0.1
    gate: float = 2.0
    start_m_s: float = 1.0
    share: float = 0.5
    borne: float = 0.5
    lift_drift: float = 0.1
    height_m: float = 0.03


FILTER: Final = FilterSettings()


def rotated(orientation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors of a base's frame, (T, 3), in the world, for orientations wxyz, (T, 4)."""
    axis = orientation[:, 1:]
    turned = np.cross(axis, vectors)
    return np.asarray(vectors + 2.0 * (orientation[:, :1] * turned + np.cross(axis, turned)))


def standing_feet(
    load: FloatArray, weight_n: float, settings: FilterSettings = FILTER
) -> npt.NDArray[np.bool_]:
    """Return which feet stand, (T, F).

    Args:
        load: Vertical load on each foot, (T, F) [N].
        weight_n: Weight of the robot [N].
        settings: Limits.
    """
    enough = load.sum(axis=1, keepdims=True) > settings.borne * weight_n
    return np.asarray((load > settings.share * load.max(axis=1, keepdims=True)) & enough)


def filtered_velocity(
    time_s: FloatArray,
    acceleration: FloatArray,
    answers: FloatArray,
    stands: npt.NDArray[np.bool_],
    settings: FilterSettings = FILTER,
) -> FloatArray:
    """Return the velocity of a base in the world, (T, 3) [m/s]: the mean of a pass forward and one backward.

    Args:
        time_s: (T,) [s].
        acceleration: Specific force in the world, (T, 3) [m/s²].
        answers: Velocity of the base by each foot, as if that foot stood, (T, F, 3) [m/s].
        stands: Which feet stand, (T, F).
        settings: Weights.
    """
    pushed = acceleration - GRAVITY
    forward = _passed(np.diff(time_s, prepend=time_s[0]), pushed, answers, stands, settings)
    back = _passed(
        np.diff(time_s[::-1], prepend=time_s[-1]), pushed[::-1], answers[::-1], stands[::-1], settings
    )
    return 0.5 * (forward + back[::-1])


def _passed(
    steps: FloatArray,
    pushed: FloatArray,
    answers: FloatArray,
    stands: npt.NDArray[np.bool_],
    settings: FilterSettings,
) -> FloatArray:
    found, speed, variance = np.empty_like(pushed), np.zeros(3), settings.start_m_s**2
    foot = settings.foot_m_s**2
    for t, step in enumerate(steps):
        speed = speed + pushed[t] * step
        variance += settings.drift**2 * abs(step)
        for answer in answers[t, stands[t]]:
            off = answer - speed
            doubt = max(1.0, float(off @ off) / (settings.gate**2 * (variance + foot)))
            gain = variance / (variance + doubt**2 * foot)
            speed = speed + gain * off
            variance *= 1.0 - gain
        found[t] = speed
    return found
