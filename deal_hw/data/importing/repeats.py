"""Leaves out samples that repeat the one before: a log that is faster than the sensor holds its last value.

A reading that rests repeats itself, too, and so does a coarse one of a slow joint. So only samples amid
motion count: the reading stands still while the joint moves on by several of its smallest steps before and
after.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.data.table import Table
from deal_hw.types import FloatArray, IntArray

STEPS: Final = 3.0
"""A reading that moves by more than this many of its smallest steps, before and after, does not rest between
[-]. A sensor's rounding alone holds a reading only where it moves by less than two."""
FEWEST: Final = 20
"""Least number of different readings amid motion, so that some chance repeats are no pattern [-]."""
HELD: Final = 0.1
"""Least share of the readings amid motion that are repeated [-]. Loggers that miss one now and then, and
joints that stop and go on, stay below."""
LONGEST: Final = 3.0
"""A reading that is held longer than this many times the median is one of a joint that stops [-]."""
REGULAR: Final = 0.9
"""Share of the readings that are held equally long, from which on the log is said to be a multiple as fast
[-]."""
SLACK: Final = 0.05
"""Readings held longer than a whole number of samples by this are held by so many [-]."""


def without_repeats(table: Table) -> tuple[Table, str]:
    """Return a recording without the samples in which all joints hold their last reading.

    Returns:
        The recording, and a sentence on what was left out; the same recording and "" without such samples.
        Where only some joints hold their readings, the samples stay, and the sentence names these joints.
    """
    if len(table.time_s) < FEWEST:
        return table, ""
    starts, lengths, held = _runs(table.position)
    if held is None:
        single = {
            name: found
            for name, column in zip(table.joint_names, table.position.T, strict=True)
            if (found := _runs(column[:, None])[2]) is not None
        }
        said = "; ".join(f"{name}: {_sentence(table, *found)}" for name, found in single.items())
        return table, said and f"{said}. The other joints do not, so these samples stay"
    # At rest a reading repeats itself for good: so many samples are kept as in the motion.
    every = math.ceil(held[0] - SLACK)
    offset = np.arange(len(table.time_s)) - np.repeat(starts, lengths)
    kept = offset % every == 0
    return table.rows(kept), f"{_sentence(table, *held)}; repeats are not fitted"


def _runs(position: FloatArray) -> tuple[IntArray, IntArray, tuple[float, float] | None]:
    """Return first sample and length of each run of equal readings, (R,), and how long they last amid motion.

    Args:
        position: (T, J); samples are equal if all joints are.

    Returns:
        The last one is None if readings are not held; else the mean length of runs amid motion [samples], and
        the share of these that have it.
    """
    changed = np.concatenate(([True], (position[1:] != position[:-1]).any(axis=1)))
    starts = np.flatnonzero(changed)
    lengths = np.diff(np.append(starts, len(position)))
    inside = lengths[1:-1][_amid_motion(position[starts])]
    if len(inside) < FEWEST or np.mean(inside > 1) < HELD:
        return starts, lengths, None
    inside = inside[inside <= LONGEST * np.median(inside)]
    mean = float(np.mean(inside))
    return starts, lengths, (mean, float(np.mean(inside == round(mean))))


def _amid_motion(readings: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which readings, (R, J), but the first and last, a joint passes without resting, (R - 2,)."""
    steps = np.diff(readings, axis=0)
    size = np.where(np.isfinite(steps) & (steps != 0), np.abs(steps), np.inf)
    far = size > STEPS * np.min(size, axis=0, initial=np.inf)
    far &= np.isfinite(size)
    onward = np.sign(steps[1:]) == np.sign(steps[:-1])
    return np.asarray((far[1:] & far[:-1] & onward).any(axis=1))


def _sentence(table: Table, mean: float, regular: float) -> str:
    rate_hz = (len(table.time_s) - 1) / float(table.time_s[-1] - table.time_s[0])
    slower = f"the readings come at {rate_hz / mean:.3g} Hz, the samples at {rate_hz:.4g} Hz"
    if regular < REGULAR:
        return f"{1 - 1 / mean:.0%} of the samples in motion repeat the one before: {slower}"
    count = round(mean)
    which = "every second sample repeats" if count == 2 else f"{count - 1} of {count} samples repeat"
    return f"{which} the one before: {slower}"
