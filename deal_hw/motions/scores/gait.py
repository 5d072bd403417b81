"""When the feet were on the floor, against a plan: duty and phase of each foot; numpy only."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.types import FloatArray

TOUCH_N: Final = 15.0
"""Force at which a foot comes down [N]: a tenth of a Go2's weight."""
LEAVE_N: Final = 5.0
"""Force below which it leaves the floor; lower than ``TOUCH_N``, so that noise makes no steps [N]."""
SHORTEST: Final = 0.1
"""Stances and gaps shorter than this share of a stride are bounces of a foot, not steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GaitScore:
    """How the feet stepped, in the description's order of legs, F of them.

    Attributes:
        strides: Number of whole turns of the clock that were judged.
        duty: Share of the time in which each foot was on the floor, (F,).
        phase: Mean phase of each foot's touchdowns on the clock, (F,) [turns]; NaN for a foot without one.
        steps: Touchdowns of each foot in a turn of the clock, (F,); 1 for a foot in time.
        duty_error: Mean over the feet of the absolute difference from the planned duty.
        phase_error: Mean over all touchdowns of the distance from the planned phase [turns]; NaN without any.
        pattern_error: Mean distance of the feet's phases from the plan if the plan may begin at any time
            [turns]: small for a policy that keeps the gait but not the clock. NaN if a foot never comes down.
        suspended: Share of the time in which no foot was on the floor.
    """

    strides: int
    duty: FloatArray
    phase: FloatArray
    steps: FloatArray
    duty_error: float
    phase_error: float
    pattern_error: float
    suspended: float


def stances(force: FloatArray, time_s: FloatArray, shortest_s: float) -> npt.NDArray[np.bool_]:
    """Return whether each foot is on the floor, (T, F).

    Args:
        force: Normal forces, (T, F) [N].
        time_s: Their times, (T,), growing [s].
        shortest_s: Shorter stances, and shorter gaps between two, do not count [s].
    """
    found = np.zeros(force.shape, dtype=bool)
    for foot in range(force.shape[1]):
        stands, rows = False, found[:, foot]
        for k, value in enumerate(force[:, foot]):
            stands = bool(value > (LEAVE_N if stands else TOUCH_N))
            rows[k] = stands
        # First the gaps: a foot that bounces as it comes down has one touchdown, the first.
        for state in (False, True):
            edges = np.flatnonzero(np.diff(rows)) + 1
            for begin, end in itertools.pairwise(edges):
                if rows[begin] == state and time_s[end] - time_s[begin] < shortest_s:
                    rows[begin:end] = not state
    return found


def gait_score(
    time_s: FloatArray, force: FloatArray, *, clock_hz: float, touchdown: Sequence[float], duty: float
) -> GaitScore | None:
    """Compare the contacts of the feet with a plan.

    Args:
        time_s: Times since the clock was zero, (T,), growing [s].
        force: Normal forces on the feet at these times, (T, F) [N].
        clock_hz: Turns of the clock in a second.
        touchdown: Planned phase at which each foot comes down, (F,) [turns].
        duty: Planned share of a stride in which a foot is on the floor.

    Returns:
        The score over the whole turns of the clock in these times; None if there is none.
    """
    first, last = int(np.ceil(time_s[0] * clock_hz)), int(np.floor(time_s[-1] * clock_hz))
    if last <= first:
        return None
    down = stances(force, time_s, SHORTEST / clock_hz)
    judged = (time_s >= first / clock_hz) & (time_s < last / clock_hz)
    begins = np.zeros_like(down)
    begins[1:] = down[1:] & ~down[:-1]
    F, plan = force.shape[1], np.asarray(touchdown)
    phase, steps, errors = np.full(F, np.nan), np.zeros(F), [np.zeros(0)]
    for foot in range(F):
        turns = time_s[judged & begins[:, foot]] * clock_hz
        steps[foot] = len(turns) / (last - first)
        if len(turns):
            phase[foot] = np.angle(np.exp(2j * np.pi * turns).mean()) / (2 * np.pi) % 1.0
            errors.append(np.abs((turns - plan[foot] + 0.5) % 1.0 - 0.5))
    every = np.concatenate(errors)
    shares = down[judged].mean(axis=0)
    return GaitScore(
        strides=last - first,
        duty=shares,
        phase=phase,
        steps=steps,
        duty_error=float(np.abs(shares - duty).mean()),
        phase_error=float(every.mean()) if every.size else float("nan"),
        pattern_error=_pattern_error(phase - plan),
        suspended=float((~down[judged].any(axis=1)).mean()),
    )


def _pattern_error(late: FloatArray) -> float:
    """Return the mean distance of phases from their plan, (F,) [turns], less what all feet have in common."""
    shift = np.angle(np.exp(2j * np.pi * late).mean()) / (2 * np.pi)
    return float(np.abs((late - shift + 0.5) % 1.0 - 0.5).mean())
