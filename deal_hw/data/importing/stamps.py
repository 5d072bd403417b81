"""Judges stamps that jitter: whether the samples were taken so, or evenly and only stamped late.

A logger stamps when a program gets to it, often milliseconds after the measurement, and rounds the stamp. The
motion shows which is true: on the right clock each sample lies near the line between its neighbours.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from deal_hw.data.table import Table
from deal_hw.types import FloatArray, IntArray

GAP_PERIODS: Final = 3.0
"""A longer step is a pause; stamps are not compared across it [periods]."""
JITTER: Final = 0.05
"""Stamps that lie off an even clock by less, as a standard deviation, are even enough to keep [periods]. A
sample at 1 rad/s and 100 Hz is then 0.5 mrad off at most."""
LOST: Final = 1.0
"""Stamps that lie off an even clock by more, as a standard deviation, have none [periods]."""
SMOOTHER: Final = 0.9
"""Samples keep their stamps if these explain the motion with this share of the even clock's error, or less
[-]. Chance alone stays within 5 % from 400 samples on."""
FEWEST: Final = 50
"""Fewer samples show no clock."""
COARSE: Final = 0.2
"""Stamps that come in steps of more are said to be rounded [periods]."""


def even_counts(clock: FloatArray) -> tuple[IntArray, float]:
    """Return how many periods each step of a clock has, (T - 1,), 0 for a pause, and the period [s].

    Each step may be one period that jitters, or a whole number of even ones with lost samples between. The
    one with the stamps nearer to its even clock is true.

    Args:
        clock: Stamps, strictly increasing, (T,), three or more [s].
    """
    steps = np.diff(clock)
    median = float(np.median(steps))
    pause = steps > GAP_PERIODS * median
    part = np.concatenate(([0], np.cumsum(pause)))
    found = []
    for each in (np.maximum(np.round(steps / median), 1), np.ones(len(steps))):
        counts: IntArray = np.where(pause, 0, each).astype(np.int64)
        number = np.concatenate(([0.0], np.cumsum(counts)))
        along, times = number - _means(number, part), clock - _means(clock, part)
        period = float(along @ times / (along @ along)) if along.any() else median
        found.append((float(np.std(times - period * along)), period, counts))
    _, period, counts = min(found, key=lambda one: one[0])
    return counts, period


def on_even_clock(table: Table) -> tuple[Table, str]:
    """Return a recording on an even clock, if its stamps jitter and its motion is smoother on that.

    Returns:
        The recording, and a sentence on the jitter; the same recording and "" where stamps are even.
    """
    clock = table.time_s
    if len(clock) < FEWEST or not np.all(np.diff(clock) > 0):
        return table, ""
    counts, period = even_counts(clock)
    part = np.concatenate(([0], np.cumsum(counts == 0)))
    number = np.concatenate(([0], np.cumsum(counts)))
    off = clock - number * period
    even = number * period + _means(off, part)
    jitter = float(np.std(clock - even)) / period
    if not JITTER < jitter < LOST:
        return table, ""
    step_s = _resolution(clock)
    how = f" and come in steps of {step_s * 1e3:.3g} ms" if step_s > COARSE * period else ""
    said = (
        f"the stamps jitter by {jitter * period * 1e3:.3g} ms (standard deviation) about {1 / period:.4g} Hz"
        f"{how}"
    )
    beside, measured = _roughness(table.position, even, part), _roughness(table.position, clock, part)
    if measured <= SMOOTHER * beside:
        return table, f"{said}; the motion is smoother at the stamps than at even times, so they are used"
    commands = table.command_s
    if np.isin(commands, clock).mean() > 0.5:
        before, after = even[0] - clock[0], even[-1] - clock[-1]
        moved = np.interp(commands, clock, even)
        moved = np.where(commands < clock[0], commands + before, moved)
        commands = np.where(commands > clock[-1], commands + after, moved)
    return (
        dataclasses.replace(table, time_s=even - even[0], command_s=commands - even[0]),
        f"{said}; the motion is as smooth at even times, so the samples are taken to be even",
    )


def _means(values: FloatArray, part: IntArray) -> FloatArray:
    """Return for each value, (T,), the mean of its part."""
    mean = np.bincount(part, values) / np.bincount(part)
    return np.asarray(mean[part])


def _resolution(clock: FloatArray) -> float:
    """Return the smallest difference between steps of the second half: the unit of rounded stamps [s]."""
    steps = np.sort(np.diff(clock[len(clock) // 2 :]))
    apart = np.diff(steps)
    # Rounding of the numbers themselves is no difference.
    apart = apart[apart > 1e-9 + 1e-3 * steps[0]]
    return float(np.min(apart, initial=np.inf)) if apart.size else 0.0


def _roughness(position: FloatArray, clock: FloatArray, part: IntArray) -> float:
    """Return how far samples lie from the line between their neighbours, over all joints [-].

    Args:
        position: (T, J).
        clock: (T,).
        part: Number of the part of each sample, (T,); lines cross no pause.
    """
    inner = part[2:] == part[:-2]
    weight = ((clock[2:] - clock[1:-1]) / (clock[2:] - clock[:-2]))[:, None]
    off = position[1:-1] - weight * position[:-2] - (1 - weight) * position[2:]
    error = np.nanmean(off[inner] ** 2, axis=0)
    spread = np.nanvar(position, axis=0)
    moves = spread > 0
    return float(np.sqrt(np.mean(error[moves] / spread[moves]))) if moves.any() else 0.0
