"""Velocity of a base from its accelerometer and its standing feet; numpy only.

A standing foot gives the velocity of the base. Feet of a trot slide when they land and take off, and
accelerometers drift: the filter combines both.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray

GRAVITY: Final = np.array([0.0, 0.0, 9.81])
"""Reading of an accelerometer at rest, in the world [m/s²]."""


DRIFT: Final = 0.5
"""Standard deviation that integrated accelerations gain in a second [m/s]. This and the further weights of
feet and accelerometer were chosen on six emulated Go2 of profile `realistic`."""
FOOT_M_S: Final = 0.1
"""Standard deviation of a standing foot's velocity [m/s]."""
GATE: Final = 2.0
"""Deviation above which a foot slides or lands and weighs less [standard deviations]."""
START_M_S: Final = 1.0
"""Standard deviation of the first velocity [m/s]."""
SWING_SHARE: Final = 0.5
"""Load below which a foot swings, as a share of the largest load."""
BORNE_SHARE: Final = 0.5
"""Total load below which no foot stands, as a share of the weight: the swing of legs looks like a third of
it."""
LIFT_DRIFT: Final = 0.1
"""The same as :data:`DRIFT`, upwards, where the height corrects it
(:func:`deal_hw.sim.legged.leg_odometry.smoothed_height`) [m/s]."""
HEIGHT_M: Final = 0.03
"""Standard deviation of the height over the standing feet in one sample [m]. It is larger than the error,
because the errors of one stance are alike."""


def standing_feet(load: FloatArray, weight_n: float) -> npt.NDArray[np.bool_]:
    """Return which feet stand, (T, F).

    Args:
        load: Vertical load on each foot, (T, F) [N].
        weight_n: Weight of the robot [N].
    """
    enough = load.sum(axis=1, keepdims=True) > BORNE_SHARE * weight_n
    return np.asarray((load > SWING_SHARE * load.max(axis=1, keepdims=True)) & enough)


def filtered_velocity(
    time_s: FloatArray,
    acceleration: FloatArray,
    answers: FloatArray,
    stands: npt.NDArray[np.bool_],
) -> FloatArray:
    """Return the velocity of a base in the world, (T, 3) [m/s]: the mean of a pass forward and one backward.

    Args:
        time_s: (T,) [s].
        acceleration: Specific force in the world, (T, 3) [m/s²].
        answers: Velocity of the base by each foot, as if that foot stood, (T, F, 3) [m/s].
        stands: Which feet stand, (T, F).
    """
    pushed = acceleration - GRAVITY
    forward = _passed(np.diff(time_s, prepend=time_s[0]), pushed, answers, stands)
    back = _passed(np.diff(time_s[::-1], prepend=time_s[-1]), pushed[::-1], answers[::-1], stands[::-1])
    return 0.5 * (forward + back[::-1])


def _passed(
    steps: FloatArray,
    pushed: FloatArray,
    answers: FloatArray,
    stands: npt.NDArray[np.bool_],
) -> FloatArray:
    found, speed, variance = np.empty_like(pushed), np.zeros(3), START_M_S**2
    foot = FOOT_M_S**2
    for t, step in enumerate(steps):
        speed = speed + pushed[t] * step
        variance += DRIFT**2 * abs(step)
        for answer in answers[t, stands[t]]:
            off = answer - speed
            doubt = max(1.0, float(off @ off) / (GATE**2 * (variance + foot)))
            gain = variance / (variance + doubt**2 * foot)
            speed = speed + gain * off
            variance *= 1.0 - gain
        found[t] = speed
    return found
