"""Parts of long recordings, on which fits and searches begin, and parts of their windows."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.problem import SHORTEST_WINDOW, Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.errors import InsufficientDataError

BEGIN_S = 8.0
"""Length of data on which a fit or a search begins [s]: it shows the neighbourhood."""


def part_of(problem: Problem, seconds: float) -> Problem:
    """Return the problem with evenly spread pieces of a second that add up to about ``seconds``."""
    lengths_s = [len(e.sample) * e.period_s for e in problem.episodes]
    # Rounding must not make a whole of a half: the ratio of two recordings to their half may be 1.9999...
    every = max(math.floor(sum(lengths_s) / seconds * (1 + 1e-9)), 1)
    kept, before_s = [], 0.0
    for episode, length_s in zip(problem.episodes, lengths_s, strict=True):
        sample = round(before_s / episode.period_s) + np.arange(len(episode.sample))
        kept.append(sample // max(round(1.0 / episode.period_s), 1) % every == 0)
        before_s += length_s
    return problem.part(kept) if every > 1 else problem


def taken(data: WindowData, chosen: npt.NDArray[Any]) -> WindowData:
    """Return the windows under a mask (W,), or at these rows."""
    names = ("measured", "std", "start_position", "start_velocity", "prior_mean", "prior_std")
    windows = dataclasses.replace(data.windows, start=data.windows.start[chosen])
    late, by_delay = (None if each is None else each[chosen] for each in (data.late, data.by_delay))
    values = {name: getattr(data, name)[chosen] for name in names}
    return dataclasses.replace(data, windows=windows, late=late, by_delay=by_delay, **values)


def measurements(windows: Sequence[WindowData]) -> int:
    """Return the number of measurements in windows."""
    return sum(int(np.count_nonzero(data.reported)) for data in windows)


def samples_in(problem: Problem, seconds: float) -> int:
    """Return the number of the slowest recording's samples in a time.

    It is at least 1 from known start states, ``SHORTEST_WINDOW`` from fitted ones.
    """
    return max(round(seconds / problem.period_s), 1 if problem.noise_free else SHORTEST_WINDOW)


def longest_windows(problem: Problem, seconds: float) -> list[WindowData]:
    """Cut windows of ``seconds``, or shorter ones where no recording holds one.

    Raises:
        InsufficientDataError: Even windows of four samples do not fit.
    """
    length = max(round(seconds / problem.period_s), SHORTEST_WINDOW)
    while True:
        try:
            return problem.windows(length)
        except InsufficientDataError:
            if length <= SHORTEST_WINDOW:
                raise
            length = max(int(0.8 * length), SHORTEST_WINDOW)
