"""Blind ranges: angles at which a sensor holds its last value, until it jumps to the other end of the range.

A potentiometer is blind between the ends of its track, and a damaged disk or magnet behaves alike. While the
joint is there, the sensor goes on reporting the end at which it came in. These samples are wrong by up to the
whole range, always to one side, and no model of the robot explains them. So they are left out, and reported.

The rule needs only the recordings. No sample lies in the range, and readings jump over it: each time by more
than ``SpikeSettings.least`` and ``speed``, at least :data:`FASTER` times as fast as the samples around move,
no farther than the range is wide and those samples move, and the motion goes on after it. A jump at n times
their speed lacks n - 1 samples, and :data:`MISSING` have to be lacking in all. Jumps of another origin do not
come back to the same place, and steps of a motion that is repeated are all as fast: :data:`CROSSINGS` jumps
are asked for, amid motion of :data:`VARIED` speeds. Angles that turn over jump by a whole turn, which is
wider than any range that is looked for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.data.checks.spikes import DEFAULT_SPIKES, Mask, SpikeSettings
from deal_hw.data.table import Table
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

AROUND: Final = 3
"""Number of steps before, and after, a jump that show how fast the joint moves."""

FASTER: Final = 1.25
"""Least speed of a jump over that of the fastest step around it [-]. Smooth motion has at most 1."""

CROSSINGS: Final = 3
"""Least number of jumps over a blind range."""

MISSING: Final = 5.0
"""Least number of samples that all jumps lack. Samples at random times would leave out as many in one of 150
cases (exp(-5)). The potentiometer of a real cart-pole lacks 6 in twelve passes at 50 Hz."""

MOST_MISSING: Final = 2.0
"""Most samples that one jump counts as lacking: around a jump from rest to rest nothing moves."""

VARIED: Final = 1.1
"""Least ratio of the fastest motion around jumps of one direction to the slowest one [-]. Six swing-ups of a
real cart-pole, all by one controller, have 1.15 and 1.19."""

NOISES: Final = 5.0
"""Distance of a value from the median held one up to which it may be held, in the sensor's noise [-]."""

WIDEST: Final = {"rad": np.pi, "m": 1.0}
"""Widest range that is looked for [rad or m]: angles that turn over jump by about 2 pi."""

NORMAL_MEDIAN: Final = 0.6745
"""Median size of a value of the standard normal distribution [-]."""


@dataclass(frozen=True, slots=True)
class BlindRange:
    """A range in which a sensor reports no position.

    Attributes:
        joint: Name of its joint.
        unit: Unit of the position, "rad" or "m".
        low: Largest position that was reported below it.
        high: Least one above it.
        turns: Whether it comes again in each turn. Then its middle is within half a turn of 0.
        held: Readings between these two may be held values: the range, and the sensor's noise at its ends.
        crossings: Number of jumps over it.
        faster: Median speed of these jumps over that of the samples around [-].
    """

    joint: str
    unit: str
    low: float
    high: float
    held: tuple[float, float]
    crossings: int
    faster: float
    turns: bool = False

    def holds(self, position: FloatArray) -> Mask:
        """Return which positions of the joint, (T,), may be held values: at the range, and before a jump."""
        low, high = self.held
        at = _within_turn(position, (self.low + self.high) / 2) if self.turns else position
        found = (at >= low) & (at <= high)
        with np.errstate(over="ignore", invalid="ignore"):
            then = at[:-1] + np.diff(position)
        found[:-1] |= (at[:-1] <= self.low) & (then >= self.high)
        found[:-1] |= (at[:-1] >= self.high) & (then <= self.low)
        return np.asarray(found)


def _within_turn(position: FloatArray, middle: float) -> FloatArray:
    """Return angles, each within half a turn of a middle."""
    return np.asarray(position - 2 * np.pi * np.round((position - middle) / (2 * np.pi)))


@dataclass(frozen=True, slots=True)
class _Jumps:
    """Steps of one joint that no motion around them explains, n of them: their ends, and how fast they are.

    Attributes:
        before: Positions before them, (n,).
        after: Positions after them, (n,).
        around: Largest step of the samples around each, (n,).
        faster: Speed over that of the fastest step around, (n,) [-].
    """

    before: FloatArray
    after: FloatArray
    around: FloatArray
    faster: FloatArray

    @classmethod
    def together(cls, each: Sequence[_Jumps]) -> _Jumps:
        """Return the jumps of several recordings."""
        names = (f.name for f in dataclasses.fields(cls))
        return cls(*(np.concatenate([getattr(one, name) for one in each]) for name in names))

    def over(self, low: float, high: float) -> _Jumps:
        """Return those over a range without samples that go no farther than motion takes them, in and out."""
        least, most = np.minimum(self.before, self.after), np.maximum(self.before, self.after)
        mine = (least <= low) & (most >= high) & (most - least <= high - low + 2 * self.around)
        return _Jumps(self.before[mine], self.after[mine], self.around[mine], self.faster[mine])

    def within_turn(self) -> _Jumps:
        """Return them with their middles within half a turn of 0."""
        middle = (self.before + self.after) / 2
        off = _within_turn(middle, 0.0) - middle
        return dataclasses.replace(self, before=self.before + off, after=self.after + off)

    @property
    def enough(self) -> bool:
        """Whether so many samples are lacking at so many speeds that no motion has them."""
        if len(self.before) < CROSSINGS or np.sum(np.minimum(self.faster - 1, MOST_MISSING)) < MISSING:
            return False
        rises = self.after > self.before
        each = [self.around[mine] for mine in (rises, ~rises) if mine.any()]
        return any(bool(np.max(around) >= VARIED * np.min(around)) for around in each)


def find_blind(tables: Iterable[Table], settings: SpikeSettings = DEFAULT_SPIKES) -> tuple[BlindRange, ...]:
    """Return the blind ranges of the sensors of one robot.

    Args:
        tables: Its recordings, without spikes, all with the same joints.
        settings: Definition of a spike: a jump exceeds its ``least`` and its ``speed``, too.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return tuple(_find(list(tables), settings))


def _find(tables: Sequence[Table], settings: SpikeSettings) -> list[BlindRange]:
    found: list[BlindRange] = []
    for column, name in enumerate(tables[0].joint_names if tables else ()):
        unit = tables[0].units[column]
        if unit not in settings.least:
            continue
        each = [_sound(table, column) for table in tables]
        noise = max(_noise(position) for _, position in each)
        jumps = _Jumps.together([_jumps(*one, unit, noise, settings) for one in each])
        if len(jumps.before) < CROSSINGS:
            continue
        values = np.concatenate([position for _, position in each])
        ranges: list[BlindRange] = []
        if unit == "rad" and float(np.ptp(values)) > 2 * np.pi:
            folded = _within_turn(values, 0.0)
            every = np.concatenate([folded - 2 * np.pi, folded, folded + 2 * np.pi])
            ranges = _ranges(name, unit, every, jumps.within_turn(), noise, settings.least[unit])
            ranges = [dataclasses.replace(one, turns=True) for one in ranges]
        found += ranges or _ranges(name, unit, values, jumps, noise, settings.least[unit])
    return found


def _sound(table: Table, column: int) -> tuple[FloatArray, FloatArray]:
    """Return stamps and positions of a joint's samples that have both, at different times."""
    time_s, position = table.time_s, table.position[:, column]
    rows = np.flatnonzero(np.isfinite(time_s) & np.isfinite(position))
    rows = rows[np.diff(time_s[rows], prepend=-np.inf) > 0]
    return time_s[rows], position[rows]


def _noise(position: FloatArray) -> float:
    """Return the standard deviation of a sensor's noise: third differences of motion itself are small."""
    if position.size < 4:
        return 0.0
    # The variance of white noise grows by 1 + 9 + 9 + 1.
    return float(np.median(np.abs(np.diff(position, 3))) / (NORMAL_MEDIAN * np.sqrt(20.0)))


def _jumps(
    time_s: FloatArray, position: FloatArray, unit: str, noise: float, settings: SpikeSettings
) -> _Jumps:
    step = np.abs(np.diff(position))
    speed = step / np.diff(time_s)
    far = (step > settings.least[unit]) & (step <= WIDEST[unit]) & (speed > settings.speed[unit])
    kept, around, faster = [], [], []
    for at in map(int, np.flatnonzero(far)):
        beside = np.r_[max(at - AROUND, 0) : at, at + 1 : min(at + 1 + AROUND, len(step))]
        later = position[min(at + 1 + AROUND, len(step))] - position[at + 1]
        goes_on = later * np.sign(position[at + 1] - position[at]) > NOISES * noise
        if goes_on and speed[at] > FASTER * (most := float(np.max(speed[beside]))):
            kept.append(at)
            around.append(float(np.max(step[beside])))
            faster.append(float(speed[at]) / max(most, 1e-12))
    rows = np.array(kept, dtype=np.int64)
    return _Jumps(position[rows], position[rows + 1], np.array(around), np.array(faster))


def _ranges(
    name: str, unit: str, values: FloatArray, jumps: _Jumps, noise: float, least: float
) -> list[BlindRange]:
    """Return the ranges without any of the values, (n,), over which jumps lead."""
    found, values = [], np.sort(values)
    for k in np.flatnonzero((np.diff(values) > least) & (np.diff(values) <= WIDEST[unit])):
        low, high = float(values[k]), float(values[k + 1])
        over = jumps.over(low, high)
        if not over.enough:
            continue
        # Where a jump begins, the value is a held one, mostly.
        below, above = over.before[over.before <= low], over.before[over.before >= high]
        held = (
            min(low, float(np.median(below)) - NOISES * noise) if below.size else low,
            max(high, float(np.median(above)) + NOISES * noise) if above.size else high,
        )
        found.append(BlindRange(name, unit, low, high, held, len(over.before), float(np.median(over.faster))))
    return found


def seen(table: Table, ranges: Sequence[BlindRange]) -> Mask:
    """Return the samples of a recording that lie in no blind range, (T,)."""
    kept = np.ones(len(table.time_s), dtype=bool)
    for one in ranges:
        kept &= ~one.holds(table.position[:, table.joint_names.index(one.joint)])
    return kept


def without_blind(table: Table, ranges: Sequence[BlindRange]) -> Table:
    """Return a recording without the samples that lie in a blind range."""
    kept = seen(table, ranges)
    return table if kept.all() else table.rows(kept)


def check_blind(table: Table, ranges: Sequence[BlindRange]) -> Finding:
    """Check a recording without spikes for samples in the blind ranges of its robot's sensors."""
    lost = 1 - float(np.mean(seen(table, ranges)))
    if not lost:
        return Finding("blind", Severity.OK, "no sensor holds its value and jumps")
    each = "; ".join(
        f"no sample lies where {r.joint} is between {r.low:.2f} and {r.high:.2f} {r.unit}"
        f"{' of a turn' if r.turns else ''}, but {r.crossings} times the reading jumps over that, "
        f"{r.faster:.2g} times as fast as it moves before and after"
        for r in ranges
    )
    return Finding(
        "blind",
        Severity.WARN,
        f"{each}: the sensor is blind there and holds its last value. Calibration leaves out the samples "
        f"that it may hold ({lost:.1%})",
        "Check the sensor at this place (a potentiometer is blind between the ends of its track), turn it, "
        "or keep the motion away from there",
    )
