"""Parts of long recordings, on which fits and searches begin, and parts of their windows."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.problem import Problem, WindowData

BEGIN_S = 8.0
"""Length of data on which a fit or a search begins [s]: it shows the neighbourhood."""


def part_of(problem: Problem, seconds: float) -> Problem:
    """Return the problem with evenly spread pieces of a second that add up to about ``seconds``."""
    lengths = [len(e.sample) for e in problem.episodes]
    period_s = problem.episodes[0].period_s
    piece = max(round(1.0 / period_s), 1)
    # Rounding must not make a whole of a half: the ratio of two recordings to their half may be 1.9999...
    every = max(math.floor(sum(lengths) * period_s / seconds * (1 + 1e-9)), 1)
    number = np.arange(sum(lengths)) // piece
    kept = np.split(number % every == 0, np.cumsum(lengths)[:-1])
    return problem.part(kept) if every > 1 else problem


def taken(data: WindowData, chosen: npt.NDArray[Any]) -> WindowData:
    """Return the windows under a mask (W,), or at these rows."""
    names = ("measured", "std", "start_position", "start_velocity", "prior_mean", "prior_std")
    windows = dataclasses.replace(data.windows, start=data.windows.start[chosen])
    late = None if data.late is None else data.late[chosen]
    values = {name: getattr(data, name)[chosen] for name in names}
    return dataclasses.replace(data, windows=windows, late=late, **values)
