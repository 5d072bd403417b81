"""Checks of any recording's stamps and values: length, numbers, clock, rate, gaps, frozen positions.

Our own recorder and the logs of others are checked by the same functions. What differs between the two is a
field of :class:`RecordingLimits`, with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.data.table import Table
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

FEWEST: Final = 3
"""With fewer samples there is no period, and nothing else can be checked."""
SHORTEST_S: Final = 2.0
"""Shortest recording of our recorder [s]: it can be made again, and longer."""
SHORTEST_PART_S: Final = 0.2
"""Shortest recording of others, or part of one [s]: it holds a window of a fit. Whether it says enough of a
parameter is judged by the fit."""
MIN_RATE_HZ: Final = 20.0
GOOD_RATE_HZ: Final = 50.0
FROZEN_S: Final = 0.5
"""A position that stays exactly the same for longer while something moves is reported [s]."""
MOVES: Final[Mapping[str, float]] = {"rad": 0.02, "m": 0.002}
"""A joint or a command with a smaller range does not move [rad or m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingLimits:
    """Limits that differ between recordings of our recorder and those of others."""

    shortest_s: float
    """Shortest recording [s]. The clock of others may have another unit, so there :func:`check_rate` judges
    the duration of a file."""

    needed: tuple[str, ...]
    """Measured quantities without which a sample cannot be used. Our frames have both: one that is not a
    number means that a sensor fails. Logs of others need no velocity."""

    most_missing: float
    """Largest share of samples that may lack one of them. Logs with several rates have rows without a
    position, which are left out; our recorder writes none."""

    most_equal: float
    """Largest share of samples with the stamp of the one before. Our devices stamp in microseconds, so equal
    stamps are measurements that were not made. Others stamp in milliseconds, so a fast log repeats some."""

    gap_periods: float
    """A longer step is a gap. Our devices send at a known rate, so that each lost frame shows; the pace of
    other loggers varies."""

    few_gaps: float
    """Share of the steps that may be gaps without a warning: a wire loses a frame here and there."""

    longest_gap_s: float
    """A longer gap is a failure [s]: our recordings are used in one piece, those of others are split."""

    most_lost: float
    """Largest share of the samples that may lie in parts, between gaps, that are too short. Our rule on the
    longest gap is stricter."""

    by_commands: bool
    """Whether a joint should move when its command does, or when other joints do. Our robots may rest, or be
    moved by hand; a recording of others without motion is useless, or has the wrong channels."""

    repair_clock: str
    """What to do about a clock that goes backwards."""

    repair_values: str
    """What to do about values that are not numbers."""

    repair_stamps: str
    """What to do about many equal stamps."""

    few_equal: str
    """What to do about a few of them."""

    repair_gaps: str
    """What to do about gaps."""


OURS: Final = RecordingLimits(
    shortest_s=SHORTEST_S,
    needed=("position", "velocity"),
    most_missing=0.0,
    most_equal=0.02,
    gap_periods=1.5,
    few_gaps=0.02,
    longest_gap_s=0.05,
    most_lost=1.0,
    by_commands=False,
    repair_clock="probably the device restarted: record again",
    repair_values="check the sensors",
    repair_stamps="check that the device measures",
    few_equal="check that the device measures",
    repair_gaps="check the cable",
)
OTHERS: Final = RecordingLimits(
    shortest_s=0.0,
    needed=("position",),
    most_missing=0.01,
    most_equal=0.05,
    gap_periods=3.0,
    few_gaps=0.0,
    longest_gap_s=np.inf,
    most_lost=0.2,
    by_commands=True,
    repair_clock="sort the rows if they are mixed up, or cut the file where the clock was set",
    repair_values="a channel is broken, or one name has two rates",
    repair_stamps="the stamps are too coarse: record with finer ones",
    few_equal="the first of each is used",
    repair_gaps="check the logger: it loses samples",
)


def check_length(table: Table, rules: RecordingLimits) -> Finding:
    """Check that there are enough samples, over enough time."""
    count = table.time_s.size
    stamps = table.time_s[np.isfinite(table.time_s)]
    duration_s = float(stamps[-1] - stamps[0]) if stamps.size else 0.0
    text = f"{duration_s:.2f} s, {count} state samples, {table.command_s.size} commands"
    if count < FEWEST or duration_s < rules.shortest_s:
        return Finding("length", Severity.FAIL, f"{text}; too short", f"record at least {SHORTEST_S:g} s")
    return Finding("length", Severity.OK, text)


def check_finite(table: Table, rules: RecordingLimits) -> Finding:
    """Check that stamps and values are numbers."""
    stamps = int(np.sum(~np.isfinite(table.time_s)) + np.sum(~np.isfinite(table.command_s)))
    if stamps:
        return Finding("finite", Severity.FAIL, f"{stamps} stamps are not numbers", "repair the time channel")
    bad = {
        (kind, joint): count
        for kind, values, joints in (
            ("position", table.position, table.joint_names),
            ("target", table.target, table.actuated),
            ("velocity", table.velocity, table.joint_names),
            ("effort", table.effort, table.joint_names),
        )
        if values is not None
        for column, joint in enumerate(joints)
        if (count := int(np.sum(~np.isfinite(values[:, column]))))
    }
    if not bad:
        return Finding("finite", Severity.OK, "all values are finite")
    named = ", ".join(f"{kind} of {joint} ({count} samples)" for (kind, joint), count in bad.items())
    text = f"values that are not finite: {named}"
    most = max((count for (kind, _), count in bad.items() if kind in rules.needed), default=0)
    if any(kind == "target" for kind, _ in bad) or most > rules.most_missing * table.time_s.size:
        return Finding("finite", Severity.FAIL, text, rules.repair_values)
    # A robot that measures no effort reports NaN, and calibration does not read it.
    remedy = "samples without a position are left out" if most else "check the sensors"
    return Finding("finite", Severity.WARN, text, remedy)


def check_clock(stamps: Mapping[str, FloatArray], rules: RecordingLimits) -> Finding:
    """Check that stamps increase.

    Args:
        stamps: Stamps of the "samples", and of what else has a clock, by name, (T,) [s].
        rules: The limits.
    """
    for what, times in stamps.items():
        back = np.flatnonzero(np.diff(times) < 0)
        if back.size:
            text = (
                f"the clock of the {what} goes backwards {back.size} times, first after sample {back[0] + 1} "
                f"({times[back[0]]:.6g} s, then {times[back[0] + 1]:.6g} s)"
            )
            return Finding("clock", Severity.FAIL, text, rules.repair_clock)
    times = stamps["samples"]
    same = int(np.sum(np.diff(times) == 0))
    if not same:
        return Finding("clock", Severity.OK, "the clock goes forward")
    text = f"{same} samples repeat the stamp of the one before"
    if same > rules.most_equal * times.size:
        return Finding("clock", Severity.FAIL, text, rules.repair_stamps)
    return Finding("clock", Severity.WARN, text, rules.few_equal)


def _steps(clock: FloatArray) -> FloatArray:
    steps = np.diff(clock)
    return steps[steps > 0]


def check_rate(clock: FloatArray) -> Finding:
    """Check rate and duration of a clock whose unit may be wrong, (T,) [s]."""
    steps = _steps(clock)
    if not steps.size:
        return Finding("rate", Severity.FAIL, "the clock stands still")
    rate_hz, duration_s = 1 / float(np.median(steps)), float(clock[-1] - clock[0])
    text = f"{rate_hz:.4g} samples per second over {duration_s:.4g} s"
    if rate_hz > 20_000 or duration_s > 1e6:
        return Finding("rate", Severity.FAIL, text, "check the unit of time")
    if duration_s < SHORTEST_PART_S:
        remedy = f"record at least {SHORTEST_PART_S:g} s, and check the unit of time"
        return Finding("rate", Severity.FAIL, text, remedy)
    if rate_hz < MIN_RATE_HZ:
        return Finding(
            "rate",
            Severity.FAIL,
            f"{text}; below {MIN_RATE_HZ:g} Hz friction cannot be separated from damping",
            "record faster, or correct the unit of time, if it is wrong",
        )
    if rate_hz < GOOD_RATE_HZ * 0.95:
        return Finding(
            "rate", Severity.WARN, f"{text}; {GOOD_RATE_HZ:g} Hz or more would give better estimates"
        )
    return Finding("rate", Severity.OK, text)


def check_gaps(clock: FloatArray, period_s: float, rules: RecordingLimits) -> Finding:
    """Check for pauses between samples.

    Recordings that gaps split are used in parts, such as roll-outs in one file.

    Args:
        clock: Stamps of the samples, (T,) [s].
        period_s: Time between samples; 0: the median of the recording's steps [s].
        rules: The limits.
    """
    steps = _steps(clock)
    period_s = period_s or (float(np.median(steps)) if steps.size else 0.0)
    gaps = steps[steps > rules.gap_periods * period_s]
    if not gaps.size:
        longest_s = float(np.max(steps, initial=0.0))
        return Finding("gaps", Severity.OK, f"no gap; longest step {longest_s * 1e3:.4g} ms")
    longest_s = float(np.max(gaps))
    length = f"{longest_s * 1e3:.4g} ms" if longest_s < 1 else f"{longest_s:.3g} s"
    if rules.longest_gap_s < np.inf:
        text = f"{gaps.size} gaps, the longest {length}; {np.sum(gaps) / np.sum(steps):.1%} of the time"
        if longest_s > max(rules.longest_gap_s, 2.5 * period_s):
            text += f"; more than {rules.longest_gap_s * 1e3:g} ms is too long"
            return Finding("gaps", Severity.FAIL, text, rules.repair_gaps)
        few = gaps.size <= rules.few_gaps * steps.size
        return Finding("gaps", Severity.OK if few else Severity.WARN, text, "" if few else rules.repair_gaps)
    parts = np.split(steps, np.flatnonzero(steps > rules.gap_periods * period_s))
    # Each part but the first begins with the gap before it.
    inside = [parts[0], *(part[1:] for part in parts[1:])]
    samples = np.array([part.size + 1 for part in inside])
    short = np.array([np.sum(part) < SHORTEST_PART_S for part in inside])
    between = f"{gaps.size} pauses between them are not fitted (the longest {length})"
    if gaps.size == 1:
        between = f"the pause between them is not fitted ({length})"
    text = f"{gaps.size + 1} parts; {between}"
    if np.sum(samples[short]) > rules.most_lost * np.sum(samples):
        text += f"; {np.count_nonzero(short)} parts are shorter than {SHORTEST_PART_S:g} s"
        return Finding("gaps", Severity.FAIL, text, rules.repair_gaps)
    return Finding("gaps", Severity.WARN, text)


def check_frozen(table: Table, rules: RecordingLimits) -> Finding:
    """Check for positions that stand still although their commands, or other joints, move."""
    names, spans = np.array(table.joint_names), _spans(table)
    moves = spans >= np.array([MOVES[unit] for unit in table.units])
    if rules.by_commands and not moves.any():
        return Finding("frozen", Severity.FAIL, "no joint moves", "check the channels and their unit")
    still_s = _command_stills(table) if rules.by_commands else _stills_among_others(table)
    stuck = {joint for joint, time_s in still_s.items() if time_s > FROZEN_S}
    constant = {joint for joint in still_s if spans[joint] == 0}
    # A joint that rests while nothing moves may be sound.
    dead = constant if rules.by_commands or stuck else set()
    if rules.by_commands:
        # Noise of a joint that its command hardly moves is no motion.
        stuck = {joint for joint in stuck if moves[joint]}
    if stuck or dead:
        whole_s = float(table.time_s[-1] - table.time_s[0])
        times_s = {joint: whole_s if joint in dead else still_s[joint] for joint in sorted(stuck | dead)}
        what = "their commands move" if rules.by_commands else "other joints move"
        listed = ", ".join(f"{names[joint]} for {time_s:.3g} s" for joint, time_s in times_s.items())
        text = f"positions without any change while {what}: {listed}"
        if dead:
            return Finding("frozen", Severity.FAIL, text, "check that the sensor is connected")
        remedy = "the joint is blocked, or the values are old: check the sensor"
        return Finding("frozen", Severity.WARN, text, remedy)
    if rules.by_commands and not moves.all():
        text = f"joints that do not move: {', '.join(names[~moves])}; their parameters cannot be estimated"
        return Finding("frozen", Severity.WARN, text, "move them, or leave them nominal")
    return Finding("frozen", Severity.OK, "no position stands still")


def _spans(table: Table) -> FloatArray:
    """Return the range of each position, 0 without a number, (J,) [rad or m]."""
    finite = [values[np.isfinite(values)] for values in table.position.T]
    return np.array([np.ptp(values) if values.size else 0.0 for values in finite])


def _command_stills(table: Table) -> dict[int, float]:
    """Return the longest time that each joint stands still while its command moves visibly [s]."""
    if not table.command_s.size:
        return {}
    held = table.target_at(table.time_s)
    found = {}
    for column, joint in enumerate(table.actuated_index):
        least, values = MOVES[table.units[joint]], held[:, column]
        if np.ptp(table.target[:, column]) < least:
            continue

        def moved(first: int, last: int, values: FloatArray = values, least: float = least) -> bool:
            return bool(np.ptp(values[first : last + 1]) > 5 * least)

        found[joint] = longest_still(table.time_s, table.position[:, joint], moved)
    return found


def _stills_among_others(table: Table) -> dict[int, float]:
    """Return the longest time that each joint stands still while others move [s]."""
    total = np.concatenate(([0], np.cumsum(np.any(table.position[1:] != table.position[:-1], axis=1))))

    def moved(first: int, last: int) -> bool:
        # Some joint moved in most of the steps.
        return bool(total[last] - total[first] > 0.5 * (last - first))

    return {
        joint: longest_still(table.time_s, values, moved) for joint, values in enumerate(table.position.T)
    }


def longest_still(time_s: FloatArray, position: FloatArray, moved: Callable[[int, int], bool]) -> float:
    """Return the longest time that a position stays exactly the same while something else moves [s].

    Args:
        time_s: Stamps, (T,) [s].
        position: One joint's positions, (T,).
        moved: Tells whether the other moved from one sample to another one, by their numbers.
    """
    changes = np.flatnonzero(position[1:] != position[:-1]) + 1
    edges = np.concatenate(([0], changes, [time_s.size - 1]))
    # In a pause nothing was measured, so nothing stood still.
    steps = np.diff(time_s)
    steps[steps > OTHERS.gap_periods * np.median(steps)] = 0.0
    spans_s = np.diff(np.concatenate(([0.0], np.cumsum(steps)))[edges])
    longest = 0.0
    for at in np.flatnonzero(spans_s > FROZEN_S):
        if spans_s[at] > longest and moved(int(edges[at]), int(edges[at + 1])):
            longest = float(spans_s[at])
    return longest
