"""Time slips: parts of a recording that follow their commands with another delay than the rest.

Causes are a clock that jumps, a writer that loses rows of one file, or a column that is shifted after some
row. The delay between commands and measurements then changes for good, or for a while. No model explains both
parts, so every parameter becomes wrong.

A joint's lag depends on its motion: a slow motion hardly lags, a fast one does. Lags of parts are therefore
not compared. One linear predictor per joint (all positions and speeds now, and its own commands around now)
is fitted to the whole recording. It is fitted again with the commands of a part shifted in time. A slip is a
shift that clearly reduces this predictor's error, and on which most joints agree.

Backlash delays small motions more than large ones, so a part with small motions looks slipped. But then the
shift does not make the parts alike: a predictor of that part alone reduces the error much further.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray, IntArray

AHEAD_S: Final = 0.1
"""The predictor looks this far ahead [s]; it uses commands from the same time before."""
TAP_S: Final = 0.02
SPEED_S: Final = 0.04
FURTHEST_S: Final = 0.15
"""Largest slip that is searched [s]."""
STEP_S: Final = 0.01
"""Step of the tried shifts [s]; at least the sampling period."""
LEAST_S: Final = 0.015
"""Smaller slips are not reported, since friction has a similar effect [s]."""
PARTS: Final = 16
SHORTEST_S: Final = 1.0
FEWEST_PARTS: Final = 8
"""A recording is cut into parts of at least a second, at most 16; with fewer than 8 there is no finding."""
FINEST_S: Final = 0.005
MOST_SAMPLES: Final = 30_000
CLEAR: Final = 0.5
"""Least decrease of the error's logarithm, divided by the shifted part's share of the recording. Recordings
without a slip reach 0.4 for shifts of 10 ms (a noise-free cart-pole). For longer shifts they reach 0.06 to
0.22 (real arms; 0.22 where one presses on a table). Slips of 20 to 60 ms reach 0.5 to 7 under fast motion;
slow motion does not show them."""
GLARING: Final = 1.5
"""From this value on, most of a fit's residual comes from the slip, so the recording is refused if it is also
:data:`ALIKE`."""
ALIKE: Final = 0.7
"""Smallest share for a refusal: decrease of the error by the shift alone, over the decrease by the shift
together with a predictor of the part's own. Slips under fast motion: 0.76 to 0.97 (one of steps: 0.67).
Pendulum and cart-pole with backlash: up to 0.68."""
AGREE: Final = 0.75
"""Share of the joints that must agree on about the same shift."""
GAP_PERIODS: Final = 3.0
TINY: Final = 1e-4
"""A joint whose position changes less within the predictor's time is ignored [rad or m]."""


@dataclass(frozen=True, slots=True)
class Slip:
    """A part of a recording that follows its commands with another delay than the rest.

    Attributes:
        begin_s: Start of the part [s].
        end_s: Its end [s].
        later_s: Additional delay; negative: less delay [s].
        clear: How much the shift reduces the error, see :data:`CLEAR`.
        agree: Share of the joints that agree on about this shift.
        alike: How alike the shift makes the part and the rest, see :data:`ALIKE`.
    """

    begin_s: float
    end_s: float
    later_s: float
    clear: float
    agree: float
    alike: float


def slip_verdict(
    time_s: FloatArray, position: FloatArray, command_s: FloatArray, target: FloatArray, actuated: IntArray
) -> Finding:
    """Check that one delay holds for the whole recording; arguments as of :func:`find_slip`."""
    found = find_slip(time_s, position, command_s, target, actuated)
    if found is None:
        return Finding(
            "slip", Severity.OK, "not checked: too short, or too little motion, to find slips of the clocks"
        )
    if found.clear < CLEAR or found.agree < AGREE or abs(found.later_s) < LEAST_S:
        return Finding("slip", Severity.OK, "one delay holds for the whole recording")
    side = "later" if found.later_s > 0 else "sooner"
    glaring = found.clear >= GLARING and found.alike >= ALIKE
    other = "" if found.alike >= ALIKE else "; backlash looks similar where motions are small"
    return Finding(
        "slip",
        Severity.FAIL if glaring else Severity.WARN,
        f"from {found.begin_s:.3g} s to {found.end_s:.3g} s measurements follow commands about "
        f"{1e3 * abs(found.later_s):.0f} ms {side} than in the rest ({found.agree:.0%} of the joints agree): "
        "the clocks slipped, rows were lost, or a column is shifted; leave one of the two parts out "
        f"(--leave-out){other}",
    )


def find_slip(
    time_s: FloatArray, position: FloatArray, command_s: FloatArray, target: FloatArray, actuated: IntArray
) -> Slip | None:
    """Return the most likely slip of a recording, clear or not; None if the data are too few.

    Args:
        time_s: Stamps of the samples, strictly increasing, (T,) [s].
        position: Measured positions, (T, J).
        command_s: Stamps of the commands, increasing, (C,) [s].
        target: Commanded positions, (C, A).
        actuated: Index of each commanded joint among the joints, (A,).
    """
    duration = float(time_s[-1] - time_s[0])
    parts = min(PARTS, int(duration / SHORTEST_S))
    if parts < FEWEST_PARTS:
        return None
    grid = _Grid.of(time_s, position, command_s, target)
    if len(grid.rows) < parts * grid.common.shape[1]:
        return None
    edges = np.linspace(0, len(grid.rows), parts + 1).astype(int)
    stretches = [(a, b) for a in range(1, parts) for b in range(a + 1, parts + 1)]
    every = [
        found
        for column, joint in enumerate(actuated)
        if (found := _moments(grid, int(joint), column, edges)) is not None
    ]
    if not every:
        return None
    gains = [np.stack([_gain(found, a, b) for a, b in stretches]) for found in every]
    total = np.mean(gains, axis=0)
    best, shift = np.unravel_index(int(np.argmax(total)), total.shape)
    a, b = stretches[int(best)]
    begin, end = edges[a], edges[b]
    apart = float(np.mean([_gain(found, a, b, own=True)[shift] for found in every]))
    share = (end - begin) / len(grid.rows)
    wanted = np.array([grid.shifts[np.argmax(gain[best])] for gain in gains])
    later = int(grid.shifts[shift])
    near = np.abs(wanted - later) <= max(grid.step, 0.4 * abs(later))
    times = grid.start_s + grid.period_s * grid.rows[[begin, end - 1]]
    return Slip(
        begin_s=float(times[0]),
        end_s=float(times[1]),
        later_s=later * grid.period_s,
        clear=float(total[best, shift]) / min(share, 1 - share),
        agree=float(np.mean(near & (np.sign(wanted) == np.sign(later)))),
        alike=float(total[best, shift]) / max(apart, 1e-300),
    )


@dataclass(frozen=True, slots=True)
class _Grid:
    """A recording at uniform times, and the data that the predictors of all joints share.

    Attributes:
        start_s: Time of the first grid point [s].
        period_s: Time between grid points [s].
        position: Measured, (N, J).
        sums: Commands held and summed from the start, (N + 1, A): means over taps are differences of these.
        rows: Grid points that are predicted from, (R,).
        ahead: Grid points that the predictor looks ahead.
        tap: Grid points of one tap.
        taps: First grid point of each tap, relative to now.
        step: Grid points between two tried shifts.
        shifts: Tried shifts, in grid points.
        common: Inputs of all predictors: positions and speeds now, and one constant, (R, 2 J + 1).
    """

    start_s: float
    period_s: float
    position: FloatArray
    sums: FloatArray
    rows: IntArray
    ahead: int
    tap: int
    taps: IntArray
    step: int
    shifts: IntArray
    common: FloatArray

    @classmethod
    def of(cls, time_s: FloatArray, position: FloatArray, command_s: FloatArray, target: FloatArray) -> _Grid:
        start, duration = float(time_s[0]), float(time_s[-1] - time_s[0])
        period = max(float(np.median(np.diff(time_s))), FINEST_S, duration / MOST_SAMPLES)
        grid = np.arange(0.0, duration, period)
        sound = np.isfinite(position).all(axis=1)
        x = np.stack([np.interp(grid + start, time_s[sound], column) for column in position[sound].T], axis=1)
        held = np.maximum(np.searchsorted(command_s, grid + start + 1e-9, side="right") - 1, 0)
        sums = np.concatenate([np.zeros((1, target.shape[1])), np.cumsum(target[held], axis=0)])
        ahead, tap, speed = (max(round(s / period), 1) for s in (AHEAD_S, TAP_S, SPEED_S))
        step = max(round(STEP_S / period), 1)
        reach = max(round(FURTHEST_S / period) // step, 1)
        first = max(speed, ahead + reach * step + tap)
        rows = np.arange(first, max(len(grid) - ahead - tap - reach * step, first))
        rows = rows[_recorded(time_s[sound] - start, grid, rows, speed, ahead)]
        now = x[rows] - x.mean(axis=0)
        common = np.concatenate([now, x[rows] - x[rows - speed], np.ones((len(rows), 1))], axis=1)
        return cls(
            start_s=start,
            period_s=period,
            position=x,
            sums=sums,
            rows=rows,
            ahead=ahead,
            tap=tap,
            taps=np.arange(-ahead, ahead, tap),
            step=step,
            shifts=np.arange(-reach, reach + 1) * step,
            common=common,
        )


def _recorded(
    time_s: FloatArray, grid: FloatArray, rows: IntArray, before: int, after: int
) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return the rows at which all inputs of the predictor were measured, without a gap, (R,)."""
    steps = np.diff(time_s)
    gap = np.flatnonzero(steps > GAP_PERIODS * np.median(steps))
    lost = np.zeros(len(grid) + 1, dtype=np.int64)
    for begin, end in zip(time_s[gap], time_s[gap + 1], strict=True):
        inside = np.searchsorted(grid, [begin, end])
        lost[inside[0] + 1 : inside[1] + 1] = 1
    lost = np.cumsum(lost)
    return np.asarray(lost[rows + after + 1] == lost[rows - before])


def _moments(grid: _Grid, joint: int, column: int, edges: IntArray) -> FloatArray | None:
    """Return the products of all columns of a joint's predictor by shift and part, (L, P, d, d)."""
    rows, now = grid.rows, grid.position[grid.rows, joint]
    change = grid.position[rows + grid.ahead, joint] - now
    if not len(rows) or np.std(change) < TINY:
        return None
    moments: list[FloatArray] = []
    for shift in grid.shifts:
        ends = rows[:, None] + grid.taps - shift
        taps = (grid.sums[ends + grid.tap, column] - grid.sums[ends, column]) / grid.tap - now[:, None]
        table = np.concatenate([grid.common, taps, change[:, None]], axis=1)
        pieces = [table[a:b] for a, b in itertools.pairwise(edges)]
        moments.append(np.stack([piece.T @ piece for piece in pieces]))
    return np.stack(moments)


def _gain(moments: FloatArray, begin: int, end: int, *, own: bool = False) -> FloatArray:
    """Return the decrease of the error's logarithm where some parts are shifted, by shift, (L,).

    With ``own``, the shifted parts also have a predictor of their own.
    """
    unshifted, shifted = moments[len(moments) // 2], moments[:, begin:end].sum(axis=1)
    whole = unshifted.sum(axis=0)
    rest = whole - unshifted[begin:end].sum(axis=0)
    left = _left(rest[None]) + _left(shifted) if own else _left(rest + shifted)
    return np.asarray(np.log(_left(whole[None]) / left))


def _left(moments: FloatArray) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the squared error of the best predictor, (L,), from its moments, (L, d, d)."""
    d = moments.shape[-1] - 1
    a, b = moments[:, :d, :d], moments[:, :d, d]
    ridge = 1e-6 * np.trace(a, axis1=1, axis2=2) / d
    weights = np.linalg.solve(a + ridge[:, None, None] * np.eye(d), b[..., None])[..., 0]
    left = moments[:, d, d] - np.einsum("li,li->l", b, weights)
    # A motion that is predicted up to rounding cannot be improved.
    return np.asarray(np.maximum(left, 1e-9 * moments[:, d, d]))
