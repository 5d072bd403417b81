"""Estimates the relation of the device's clock to the host's from a recording alone.

Every state sample bounds the relation from one side: it cannot arrive before it was sent. Every command that
the device reports in force bounds it from the other: it cannot be received before it was sent. All straight
lines ``host = device + offset + drift * (device - reference)`` between the two sets of bounds are possible;
the middle of them is the estimate, their extent is the uncertainty. Nothing is assumed on how delays are
distributed. (The one-sided form is the convex-hull method of Zhang, Liu and Xia, 2002, for one-way delays.)
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.errors import InsufficientDataError
from deal_hw.schema import plain
from deal_hw.types import FloatArray, Trajectory

STAMP_RESOLUTION_S = 2e-6
"""Device stamps and ages are whole microseconds; each bound is loosened by that much."""
JUMP_S = 5e-3
"""Smaller changes of a clock [s] cannot be distinguished from changes of delay."""
_JUMP_WINDOW_S = 5.0
_JUMP_MARGIN_S = 0.25
Bounds = tuple[FloatArray, FloatArray]
"""Device times (M,) and differences host - device (M,) [s]."""


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A jump: one clock was set, so the clocks' difference changed permanently between two samples.

    Attributes:
        index: The first sample after it.
        device_s: That sample's time, on the base of ``Trajectory.device_s`` [s].
        size_s: Change of host minus device [s]; positive: the device's clock fell back.
    """

    index: int
    device_s: float
    size_s: float


@dataclass(frozen=True, slots=True)
class ClockSync:
    """Relation of the host's clock to the device's, on the time bases of a Trajectory.

    Attributes:
        reference_s: Device time at which ``offset_s`` holds [s].
        offset_s: Host minus device at the reference [s].
        offset_uncertainty_s: Half of the possible range [s]; infinite without commands (one-sided). The
            offset then still contains the smallest delay of a state sample.
        drift_ppm: Host seconds gained per million device seconds.
        drift_uncertainty_ppm: Half of the possible range; infinite if that is unbounded.
        jumps: Where a clock was set; the estimate then holds for the longest stretch without one.
    """

    reference_s: float
    offset_s: float
    offset_uncertainty_s: float
    drift_ppm: float
    drift_uncertainty_ppm: float
    jumps: tuple[ClockJump, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite uncertainties as null."""
        values: dict[str, Any] = plain(self)
        return values


def synchronize(trajectory: Trajectory) -> ClockSync:
    """Estimate the relation of the clocks.

    Raises:
        InsufficientDataError: Fewer than two samples, or the stamps contradict each other.
    """
    if trajectory.device_s.size < 2:
        raise InsufficientDataError(
            f"{trajectory.device_s.size} state samples cannot relate two clocks; at least 2 are needed"
        )
    jumps = find_jumps(trajectory.device_s, trajectory.receive_s - trajectory.device_s)
    start, stop = _longest_stretch(trajectory.device_s.size, jumps)
    device_s = trajectory.device_s[start:stop]
    upper = _hull((device_s, trajectory.receive_s[start:stop] - device_s + STAMP_RESOLUTION_S), below=True)
    lower = _hull(command_bounds(trajectory, start, stop), below=False)
    reference_s = float(0.5 * (device_s[0] + device_s[-1]))
    if not lower[0].size:
        drift = _envelope_slope(upper, reference_s)
        most = _extreme(upper, drift, reference_s, np.min)
        return ClockSync(reference_s, most, np.inf, drift * 1e6, np.inf, jumps)
    lower, low, high = _reconcile(upper, lower)
    bounded = np.isfinite(low) and np.isfinite(high)
    drift = 0.5 * (low + high) if bounded else _envelope_slope(upper, reference_s)
    most = _extreme(upper, drift, reference_s, np.min)
    least = _extreme(lower, drift, reference_s, np.max)
    half_range = 0.5 * (high - low) * 1e6
    return ClockSync(reference_s, 0.5 * (most + least), 0.5 * (most - least), drift * 1e6, half_range, jumps)


def command_bounds(trajectory: Trajectory, start: int = 0, stop: int | None = None) -> Bounds:
    """Return the bounds by commands: device time of reception, and send minus reception time [s].

    Args:
        trajectory: A recording.
        start: First state sample to use.
        stop: One past the last state sample to use.
    """
    part = slice(start, stop)
    order = np.argsort(trajectory.sent_sequence, kind="stable")
    numbers, sent_s = trajectory.sent_sequence[order], trajectory.sent_s[order]
    in_force = trajectory.command_sequence[part]
    place = np.searchsorted(numbers, in_force)
    place[place == numbers.size] = 0
    if not numbers.size:
        return np.empty(0), np.empty(0)
    age_s = trajectory.command_age_s[part]
    # A number left over from an earlier session matches a command not yet sent: it is too old.
    causal = trajectory.receive_s[part] - age_s >= sent_s[place] - JUMP_S
    usable = np.flatnonzero((numbers[place] == in_force) & (in_force >= 0) & causal)
    _, first = np.unique(in_force[usable], return_index=True)
    usable = np.sort(usable[first])
    received_s = trajectory.device_s[part][usable] - age_s[usable]
    difference_s = sent_s[place[usable]] - received_s - STAMP_RESOLUTION_S
    sort = np.argsort(received_s, kind="stable")
    return received_s[sort], difference_s[sort]


def find_jumps(device_s: FloatArray, difference_s: FloatArray) -> tuple[ClockJump, ...]:
    """Find the jumps, where host minus device time changed permanently.

    A delay also changes the difference, but only until the samples are on time again. So a jump is where the
    smallest difference of the seconds before differs from that of the seconds after. A device clock that runs
    backwards is always a jump.

    Args:
        device_s: Device time of each sample, (T,) [s].
        difference_s: Host minus device time of each sample, (T,) [s].
    """
    steps = np.diff(difference_s)
    backwards = np.flatnonzero(np.diff(device_s) < 0) + 1
    candidates = np.union1d(np.flatnonzero(np.abs(steps) > JUMP_S) + 1, backwards)
    jumps: list[ClockJump] = []
    last = 0
    for index in candidates.tolist():
        later = backwards[backwards > index]
        stop = int(later[0]) if later.size else device_s.size
        step = float(steps[index - 1])
        change = step
        if index not in backwards:
            before = _least_near(device_s, difference_s, last, index, -1)
            after = _least_near(device_s, difference_s, index, stop, 1)
            if before is None or after is None:
                continue
            change = after - before
            # The change must have happened here, not at another candidate within the same seconds.
            if abs(change) <= JUMP_S or step * change <= 0 or abs(step) < 0.5 * abs(change):
                continue
        jumps.append(ClockJump(index, float(device_s[index]), change))
        last = index
    return tuple(jumps)


def _least_near(
    device_s: FloatArray, difference_s: FloatArray, start: int, stop: int, side: int
) -> float | None:
    """Return the smallest difference in the seconds before or after a place; None if too few samples."""
    part, values = device_s[start:stop], difference_s[start:stop]
    if part.size < 2 or part[-1] - part[0] < _JUMP_MARGIN_S:
        return None
    near = part >= part[-1] - _JUMP_WINDOW_S if side < 0 else part <= part[0] + _JUMP_WINDOW_S
    return float(np.min(values[near]))


def _longest_stretch(samples: int, jumps: tuple[ClockJump, ...]) -> tuple[int, int]:
    edges = [0, *(jump.index for jump in jumps), samples]
    start, stop = max(itertools.pairwise(edges), key=lambda pair: pair[1] - pair[0])
    if stop - start < 2:
        raise InsufficientDataError(
            f"{len(jumps)} clock jumps leave no part long enough to relate the clocks; do not set clocks "
            "while recording"
        )
    return start, stop


def _reconcile(upper: Bounds, lower: Bounds) -> tuple[Bounds, float, float]:
    """Return the bounds loosened until a line fits between them, and the range of its slope.

    A host that stamps a command after writing it, or stalls in between, sets its bound too high.
    """
    slack_s = 0.0
    while slack_s < 2 * JUMP_S:
        loosened = lower[0], lower[1] - slack_s
        low, high = _drift_range(upper, loosened)
        if low <= high:
            return loosened, low, high
        slack_s = max(2 * slack_s, 1e-5)
    raise InsufficientDataError(
        f"stamps of states and commands contradict each other by more than {JUMP_S} s: "
        "something was received before it was sent. Probably a clock was set meanwhile; record again"
    )


def _drift_range(upper: Bounds, lower: Bounds) -> tuple[float, float]:
    """Return the least and greatest slope of a line below all upper and above all lower bounds."""
    apart = upper[0][:, None] - lower[0][None, :]
    gap = upper[1][:, None] - lower[1][None, :]
    if np.any(gap[apart == 0] < 0):
        return np.inf, -np.inf
    slope = np.divide(gap, apart, out=np.zeros_like(gap), where=apart != 0)
    low = float(np.max(slope[apart < 0], initial=-np.inf))
    high = float(np.min(slope[apart > 0], initial=np.inf))
    return low, high


def _extreme(bounds: Bounds, drift: float, reference_s: float, choose: Any) -> float:
    return float(choose(bounds[1] - drift * (bounds[0] - reference_s)))


def _hull(bounds: Bounds, below: bool) -> Bounds:
    """Return the corners of the lower (or upper) convex hull: all other bounds follow from them."""
    sign = 1.0 if below else -1.0
    corners: list[tuple[float, float]] = []
    for point in zip(bounds[0].tolist(), (sign * bounds[1]).tolist(), strict=True):
        while len(corners) >= 2 and _is_above(corners[-2], corners[-1], point):
            corners.pop()
        corners.append(point)
    points = np.array(corners, dtype=np.float64).reshape(-1, 2)
    return points[:, 0], sign * points[:, 1]


def _is_above(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Return whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])


def _envelope_slope(hull: Bounds, reference_s: float) -> float:
    """Return the slope of the hull's edge at the reference: the highest line below all samples there."""
    if hull[0].size < 2:
        return 0.0
    edge = int(np.clip(np.searchsorted(hull[0], reference_s) - 1, 0, hull[0].size - 2))
    return float((hull[1][edge + 1] - hull[1][edge]) / (hull[0][edge + 1] - hull[0][edge]))
