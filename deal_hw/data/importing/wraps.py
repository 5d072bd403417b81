"""Unwraps angles that were folded into one turn: -pi..pi, 0..2 pi, 0..360 degrees.

A folded angle jumps by a full turn where the joint goes on smoothly. Nothing can be interpolated,
differenced or predicted across such a jump, so whole turns are added after it.
"""

from __future__ import annotations

import numpy as np

from deal_hw.types import FloatArray

TURN = 2 * np.pi
WIDEST = 1.02
"""A folded angle lies within this many turns; noise at the seam may reach beyond one."""
FEWEST = 20
"""Fewer samples show no motion that a jump could be compared with."""
FASTEST, USUAL = np.pi / 2, 0.9
"""If less than this share of the steps is shorter, a jump says little [rad]."""
GAP_PERIODS = 3.0
"""Steps over a longer pause say nothing of the motion [sampling periods]."""
NEIGHBOURS = 4
"""Steps on each side of a jump that tell how fast the joint moves there."""
FASTER = 3.0
"""Without its full turn, a jump is no longer than this many times the longest step around it ..."""
REST_RAD = 0.1
"""... or than this: noise and the first step of a motion, where the joint was at rest [rad]."""


def unwrap(angle: FloatArray, time_s: FloatArray) -> tuple[FloatArray, int]:
    """Return an angle without jumps by full turns, and how many there were.

    A jump of more than half a turn counts if a full turn less leaves a step like those around it, per time.
    Other jumps of that size stay: spikes and faults, for the checks to name. If there are more of these, or
    the angle goes beyond one turn, or few steps are well below half a turn, all is returned as it is.

    Args:
        angle: (T,) [rad]; what is not finite stays.
        time_s: Stamps, (T,) [s].
    """
    sound = np.flatnonzero(np.isfinite(angle) & np.isfinite(time_s))
    values = angle[sound]
    if values.size < FEWEST or np.ptp(values) > WIDEST * TURN:
        return angle, 0
    steps = np.diff(values)
    jumps = np.flatnonzero(np.abs(steps) > np.pi)
    if not jumps.size:
        return angle, 0
    turns = np.round(steps / TURN)
    left = np.abs(steps - turns * TURN)
    elapsed = np.maximum(np.diff(time_s[sound]), 1e-9)
    if np.quantile(left[elapsed <= GAP_PERIODS * np.median(elapsed)], USUAL) > FASTEST:
        return angle, 0
    rate = left / elapsed
    # One jump does not vouch for another: a spike is two.
    rate[jumps] = 0.0
    folds = []
    for at in jumps:
        before, after = rate[max(at - NEIGHBOURS, 0) : at], rate[at + 1 : at + 1 + NEIGHBOURS]
        fastest = max(float(np.max(side, initial=0.0)) for side in (before, after))
        if left[at] <= FASTER * fastest * elapsed[at] + REST_RAD:
            folds.append(at)
    if 2 * len(folds) <= jumps.size:
        return angle, 0
    counted = np.zeros(steps.size)
    counted[folds] = turns[folds]
    found = angle.copy()
    found[sound] = values - TURN * np.concatenate(([0.0], np.cumsum(counted)))
    return found, len(folds)


def nearest_turn(angle: FloatArray, near: FloatArray) -> FloatArray:
    """Return angles with whole turns added so that each is within half a turn of another, (N,) both."""
    return np.asarray(angle + TURN * np.round((near - angle) / TURN))
