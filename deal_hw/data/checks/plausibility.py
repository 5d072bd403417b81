"""Checks of a recording of unknown origin, before any long work: clock, units, joints, commands.

``recording/telemetry_checks`` checks files of our own recorder. These checks find the usual errors of other
logs: a clock in the wrong unit or running backwards, degrees for radians, joints in another order or with
another sign, a target that is a copy of the measurement. A check returns one
:class:`~deal_hw.data.recording.telemetry_checks.Finding`; with "fail" the recording is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.data.checks.joint_match import match
from deal_hw.data.checks.slip import slip_verdict
from deal_hw.data.checks.speed import speed_verdict
from deal_hw.data.importing.table import Table
from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings, find_spikes, sound
from deal_hw.data.recording.telemetry_checks import spikes_verdict
from deal_hw.errors import DatasetError
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

MIN_RATE_HZ, GOOD_RATE_HZ = 20.0, 50.0
MIN_DURATION_S = 2.0
GAP_PERIODS = 3.0
MAX_LOST = 0.2
"""Share of a recording's time that may lie in gaps."""
MAX_NAN = 0.01
MAX_DUPLICATES = 0.05
MOVES = {"rad": 0.02, "m": 0.002}
"""A joint with a smaller range of positions does not move [rad or m]."""
FAR = {"rad": 1.0, "m": 0.2}
"""A position that is always farther from its command than this is reported [rad or m]."""
FROZEN_S = 0.5
DEGREES = 180 / np.pi
SCALE_TOLERANCE = 0.25
"""Tolerance within which a ratio of spans counts as a known factor."""
FURTHEST = 2 * np.pi
"""A servo joint without limits seldom turns farther [rad]."""
FOLLOWS = 0.8
"""A joint with this correlation or more follows its command [-]."""
OUTSIDE = 0.05
"""Share of the limits' span by which positions may lie outside (compliance, a soft stop)."""
FLAT = 0.1
"""A continuous signal exactly at its extreme for this share of the time is clipped."""


def examine(
    table: Table,
    limits: FloatArray | None = None,
    kept: Table | None = None,
    spikes: SpikeSettings = DEFAULT_SPIKES,
    efforts: bool = False,
) -> tuple[Finding, ...]:
    """Run all checks on a recording; the order is fixed.

    If clock or values are unusable, the later checks are skipped: they would only repeat it. Spikes are
    reported, and the later checks use the recording without them.

    Args:
        table: The recording, on its own stamps.
        limits: Lowest and highest position of each joint in the model, (J, 2) [rad or m]; infinite if free.
        kept: The recording without the left-out parts, in which slips do no harm.
        spikes: Definition of a spike.
        efforts: Commands are efforts of motors: where they never change, the joints move by themselves.
    """
    first = [_size(table), _finite(table), _clock(table)]
    if any(verdict.severity is Severity.FAIL for verdict in first):
        return tuple(first)
    clock = table.time_s[np.isfinite(table.position).all(axis=1)]
    rate = _rate(clock)
    if rate.severity is Severity.FAIL:
        return (*first, rate)
    jumps = spikes_verdict(table.time_s, table.position, table.joint_names, table.units, spikes)
    table = despiked(table, spikes)
    middle = [rate, _gaps(clock), jumps, _frozen(table), speed_verdict(table), _commands(table, efforts)]
    if not table.command_s.size or not table.actuated:
        return (*first, *middle)
    units, other_unit = _units(table, limits)
    # Positions in another unit than commands also lie far from them and outside the limits: no other cause.
    return (
        *first,
        *middle,
        _copy(table),
        units,
        *([] if other_unit else [_levels(table), _inside_limits(table, limits)]),
        *match(table),
        _slip(kept or table),
        _clipped_commands(table, limits),
        _saturated_effort(table),
        _excitation(table),
        *([_quaternion(table)] if table.orientation is not None else []),
    )


def despiked(table: Table, settings: SpikeSettings) -> Table:
    """Return a recording without the samples that jump and come back, see :class:`SpikeSettings`."""
    found = find_spikes(table.time_s, table.position, table.units, settings)
    return table.rows(sound(found, table.time_s.size)) if found else table


def require(verdicts: Sequence[Finding], name: str) -> None:
    """Refuse a recording with a failed check.

    Raises:
        DatasetError: A check failed; the message contains the sentence of each failed check.
    """
    failed = [
        f"{verdict.code}: {verdict.message}" for verdict in verdicts if verdict.severity is Severity.FAIL
    ]
    if failed:
        raise DatasetError(f"{name} cannot be used: {'; '.join(failed)}")


def _verdict(name: str, severity: Severity, message: str) -> Finding:
    return Finding(name, severity, message)


def _size(table: Table) -> Finding:
    count = table.time_s.size
    text = f"{count} samples, {table.command_s.size} commands, {len(table.joint_names)} joints"
    return _verdict("size", Severity.OK if count >= 3 else Severity.FAIL, text)


def _finite(table: Table) -> Finding:
    counts = {
        f"{kind} of {joint}": (int(np.sum(~np.isfinite(values[:, column]))), kind)
        for kind, values, joints in (
            ("position", table.position, table.joint_names),
            ("target", table.target, table.actuated),
            ("velocity", table.velocity, table.joint_names),
            ("effort", table.effort, table.joint_names),
        )
        if values is not None
        for column, joint in enumerate(joints)
    }
    bad = {name: found for name, found in counts.items() if found[0]}
    stamps = int(np.sum(~np.isfinite(table.time_s)) + np.sum(~np.isfinite(table.command_s)))
    if stamps:
        return _verdict("finite", Severity.FAIL, f"{stamps} stamps are not numbers; repair the time channel")
    if not bad:
        return _verdict("finite", Severity.OK, "all values are finite")
    text = "values that are not finite: " + ", ".join(
        f"{name} ({count} samples)" for name, (count, _) in bad.items()
    )
    worst = max((count for count, kind in bad.values() if kind == "position"), default=0)
    targets = any(kind == "target" for _, kind in bad.values())
    if targets or worst > MAX_NAN * table.time_s.size:
        return _verdict("finite", Severity.FAIL, f"{text}; a channel is broken, or one name has two rates")
    return _verdict("finite", Severity.WARN, f"{text}; samples without a position are left out")


def _clock(table: Table) -> Finding:
    for what, stamps in (("samples", table.time_s), ("commands", table.command_s)):
        steps = np.diff(stamps)
        back = np.flatnonzero(steps < 0)
        if back.size:
            text = (
                f"the clock of the {what} goes backwards {back.size} times, first after sample {back[0] + 1} "
                f"({stamps[back[0]]:.6g} s, then {stamps[back[0] + 1]:.6g} s); sort the rows if they are "
                "mixed up, or cut the file where the clock was set"
            )
            return _verdict("clock", Severity.FAIL, text)
    same = int(np.sum(np.diff(table.time_s) == 0))
    if not same:
        return _verdict("clock", Severity.OK, "the clock goes forward")
    text = f"{same} samples repeat the stamp of the one before; the first of each is used"
    if same > MAX_DUPLICATES * table.time_s.size:
        return _verdict("clock", Severity.FAIL, f"{text}: the stamps are too coarse; record with finer ones")
    return _verdict("clock", Severity.WARN, text)


def _steps(clock: FloatArray) -> FloatArray:
    steps = np.diff(clock)
    return steps[steps > 0]


def _rate(clock: FloatArray) -> Finding:
    steps = _steps(clock)
    if not steps.size:
        return _verdict("rate", Severity.FAIL, "the clock stands still")
    rate_hz, duration_s = 1 / float(np.median(steps)), float(clock[-1] - clock[0])
    text = f"{rate_hz:.4g} samples per second over {duration_s:.4g} s"
    if rate_hz > 20_000 or duration_s > 1e6:
        return _verdict("rate", Severity.FAIL, f"{text}; check the unit of time")
    if duration_s < MIN_DURATION_S:
        return _verdict(
            "rate", Severity.FAIL, f"{text}; record at least {MIN_DURATION_S:g} s, and check the unit of time"
        )
    if rate_hz < MIN_RATE_HZ:
        text = (
            f"{text}; below {MIN_RATE_HZ:g} Hz friction cannot be separated from damping: record faster, or "
            "correct the unit of time, if it is wrong"
        )
        return _verdict("rate", Severity.FAIL, text)
    if rate_hz < GOOD_RATE_HZ * 0.95:
        return _verdict(
            "rate", Severity.WARN, f"{text}; {GOOD_RATE_HZ:g} Hz or more would give better estimates"
        )
    return _verdict("rate", Severity.OK, text)


def _gaps(clock: FloatArray) -> Finding:
    steps = _steps(clock)
    period = float(np.median(steps))
    long = steps[steps > GAP_PERIODS * period]
    if not long.size:
        return _verdict("gaps", Severity.OK, f"no gap; longest step {np.max(steps) * 1e3:.4g} ms")
    lost = float(np.sum(long) / (clock[-1] - clock[0]))
    text = (
        f"{long.size} gaps, the longest {np.max(long):.3g} s; {lost:.1%} of the time; the "
        "recording is split there"
    )
    return _verdict("gaps", Severity.FAIL if lost > MAX_LOST else Severity.WARN, text)


def _moves(table: Table) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which joints move, (J,)."""
    least = np.array([MOVES[unit] for unit in table.units])
    return np.asarray(np.nanmax(table.position, axis=0) - np.nanmin(table.position, axis=0) >= least)


def _frozen(table: Table) -> Finding:
    moves = _moves(table)
    commanded = np.zeros(len(table.joint_names), dtype=bool)
    if table.command_s.size:
        least = np.array([MOVES[unit] for unit in table.units])[list(table.actuated_index)]
        commanded[list(table.actuated_index)] = np.ptp(table.target, axis=0) >= least
    constant = np.nanmax(table.position, axis=0) == np.nanmin(table.position, axis=0)
    names = np.array(table.joint_names)
    if not moves.any():
        return _verdict("frozen", Severity.FAIL, "no joint moves; check the channels and their unit")
    dead = names[constant & commanded]
    if dead.size:
        text = f"positions without any change although commands move: {', '.join(dead)}; check the sensor"
        return _verdict("frozen", Severity.FAIL, text)
    stuck = [
        f"{name} for {still:.2g} s"
        for index, name in enumerate(table.joint_names)
        if commanded[index] and moves[index] and (still := _longest_still(table, index)) > FROZEN_S
    ]
    if stuck:
        text = (
            f"positions do not change at all while their commands move: {', '.join(stuck)}; the joint is "
            "blocked, or the values are old"
        )
        return _verdict("frozen", Severity.WARN, text)
    if not moves.all():
        text = (
            f"joints that do not move: {', '.join(names[~moves])}; their parameters cannot be "
            "estimated: move them, or leave them nominal"
        )
        return _verdict("frozen", Severity.WARN, text)
    return _verdict("frozen", Severity.OK, "every joint moves")


def _longest_still(table: Table, joint: int) -> float:
    """Return the longest time that a position stays exactly the same while its command moves visibly [s]."""
    column = table.actuated.index(table.joint_names[joint])
    target, moved = table.target_at(table.time_s)[:, column], MOVES[table.units[joint]]
    changes = np.flatnonzero(np.diff(table.position[:, joint]) != 0) + 1
    edges = np.concatenate(([0], changes, [table.time_s.size - 1]))
    longest = 0.0
    spans_s = np.diff(table.time_s[edges])
    for at in np.flatnonzero(spans_s > FROZEN_S):
        if spans_s[at] > longest and np.ptp(target[edges[at] : edges[at + 1] + 1]) > 5 * moved:
            longest = float(spans_s[at])
    return longest


def _commands(table: Table, efforts: bool) -> Finding:
    if not table.command_s.size:
        text = (
            "no commanded positions, so nothing can be predicted; name them as `target` in the column map. "
            "If a policy moved the robot, calibrate --policy FILE.onnx computes its commands. "
            "If the joints swing freely with their servos off, remove the actuators from a copy of the MJCF"
        )
        return _verdict("commands", Severity.FAIL, text)
    begin, end = float(table.command_s[0]), float(table.command_s[-1])
    inside = min(end, table.time_s[-1]) - max(begin, table.time_s[0])
    text = f"{table.command_s.size} commands from {begin:.4g} s to {end:.4g} s"
    if inside < 0.5 * min(end - begin, table.time_s[-1]):
        text = (
            f"{text}, samples from 0 s to {table.time_s[-1]:.4g} s; check that both have one clock and the "
            "right unit"
        )
        return _verdict("commands", Severity.FAIL, text)
    still = [
        name for name, span in zip(table.actuated, np.ptp(table.target, axis=0), strict=True) if span == 0
    ]
    if len(still) == len(table.actuated) and not efforts:
        return _verdict("commands", Severity.FAIL, f"{text}; no command ever changes: record a motion")
    return _verdict("commands", Severity.OK, text)


def _copy(table: Table) -> Finding:
    held, measured = table.target_at(table.time_s), table.position[:, list(table.actuated_index)]
    copied = []
    for column, name in enumerate(table.actuated):
        for lag in range(6):
            ahead = held[: held.shape[0] - lag, column]
            behind = measured[lag:, column]
            moving = np.abs(np.diff(behind, prepend=behind[0])) > 0
            if np.sum(moving) > 20 and np.mean(np.abs(ahead - behind)[moving] < 1e-7) > 0.9:
                copied.append(f"{name}, {lag} samples later" if lag else name)
                break
    if not copied:
        return _verdict("copy", Severity.OK, "measured and commanded positions differ")
    text = (
        f"measured positions that are a copy of the command: {', '.join(copied)}; one of the two channels "
        "is wrong: correct the column map"
    )
    return _verdict("copy", Severity.FAIL, text)


def _slip(table: Table) -> Finding:
    # The clock's check reports repeated stamps; here the first of each counts.
    new = np.concatenate([[True], np.diff(table.time_s) > 0])
    return slip_verdict(
        table.time_s[new], table.position[new], table.command_s, table.target, np.array(table.actuated_index)
    )


_FACTORS = {DEGREES: "degrees for radians", 1000.0: "millimetres for metres"}


def _units(table: Table, limits: FloatArray | None) -> tuple[Finding, bool]:
    """Compare the spans of command and measurement, and both with the model's limits.

    Returns:
        The result, and whether commands and positions of a joint have different units.
    """
    held, found = table.target_at(table.time_s), list[str]()
    alike_factor: dict[tuple[str, float], list[str]] = {}
    for column, index in enumerate(table.actuated_index):
        target, measured, name = held[:, column], table.position[:, index], table.joint_names[index]
        spans = _span(target), _span(measured)
        alike = abs(_correlation(target, measured))
        if min(spans) <= 0 or alike < 0.3:
            continue
        ratio = spans[0] / spans[1]
        factors = [
            (f"the {larger}'s range is about {factor:.3g} times the {smaller}'s", factor)
            for factor in _FACTORS
            for larger, smaller, share in (
                ("command", "measurement", ratio / factor),
                ("measurement", "command", 1 / (ratio * factor)),
            )
            if abs(share - 1) < SCALE_TOLERANCE
        ]
        for words_and_factor in factors[:1]:
            alike_factor.setdefault(words_and_factor, []).append(name)
        if not factors and alike > 0.8 and not 0.2 < ratio < 5:
            found.append(
                f"{name}: command and measurement move alike but their ranges differ "
                f"{max(ratio, 1 / ratio):.3g} "
                f"times ({_normal_range(target if ratio > 1 else measured)})"
            )
    explained = [name for names in alike_factor.values() for name in names]
    found = [
        f"{', '.join(names)}: {words} ({_FACTORS[factor]})" for (words, factor), names in alike_factor.items()
    ] + found
    found += _beyond_limits(table, limits, explained)
    if found:
        text = f"{'; '.join(found)}. Give the unit in the column map (unit, target_unit, normalised)"
        return _verdict("units", Severity.FAIL, text), bool(explained)
    suspects = [
        f"{name} ({bottom}..{top})"
        for name, index in zip(table.actuated, table.actuated_index, strict=True)
        for bottom, top in ((0, 1), (-1, 1), (-100, 100))
        if _fills(table.position[:, index], bottom, top)
    ]
    if suspects:
        text = (
            f"positions that seem normalised (they fill a range without a unit): {', '.join(suspects)}; if "
            "they are, give `normalised` in the column map"
        )
        return _verdict("units", Severity.WARN, text), False
    return _verdict("units", Severity.OK, "ranges of commands and measurements agree"), False


def _levels(table: Table) -> Finding:
    held, found = table.target_at(table.time_s), []
    for column, index in enumerate(table.actuated_index):
        off = float(np.nanmedian(table.position[:, index] - held[:, column]))
        span = max(_span(table.position[:, index]), _span(held[:, column]))
        if abs(off) > max(FAR[table.units[index]], 3 * span):
            found.append(f"{table.joint_names[index]} {off:+.3g} {table.units[index]}")
    if not found:
        return _verdict("levels", Severity.OK, "measurements are near their commands")
    text = f"measurements are far from their commands all the time: {', '.join(found)}"
    return _verdict(
        "levels", Severity.FAIL, f"{text}; check for another joint's channel, or another zero (offset)"
    )


def _beyond_limits(table: Table, limits: FloatArray | None, explained: Sequence[str] = ()) -> list[str]:
    """Return what positions beyond the limits say of joints whose unit is not ``explained`` yet."""
    found = []
    for index, name in enumerate(table.joint_names):
        if name in explained:
            continue
        values = table.position[:, index]
        low, high = (-np.inf, np.inf) if limits is None else limits[index]
        reach = float(np.nanmax(np.abs(values)))
        bounded = np.isfinite(low) and np.isfinite(high)
        if not bounded and index not in table.actuated_index:
            # A pole may make many turns.
            continue
        furthest = max(abs(low), abs(high)) if bounded else 4 * np.pi
        if table.units[index] == "rad" and reach > 3 * furthest and reach < 1000:
            kind = f"degrees, or {_normal_range(values)}" if reach <= 105 else "degrees"
            found.append(f"{name}: positions reach {reach:.4g} rad, the joint {furthest:.3g} rad ({kind}?)")
        elif table.units[index] == "m" and bounded and reach > 20 * furthest:
            found.append(f"{name}: positions reach {reach:.4g} m, the joint {furthest:.3g} m (millimetres?)")
    return found


def _fills(values: FloatArray, bottom: float, top: float) -> bool:
    slack = 0.02 * (top - bottom)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return abs(low - bottom) < slack and abs(high - top) < slack


def _normal_range(values: FloatArray) -> str:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    for bottom, top in ((0, 1), (-1, 1), (0, 100), (-100, 100)):
        slack = 0.05 * (top - bottom)
        if bottom - slack <= low and high <= top + slack:
            return f"a channel normalised to {bottom}..{top}"
    return "another unit"


def _inside_limits(table: Table, limits: FloatArray | None) -> Finding:
    if limits is None:
        return _verdict("limits", Severity.OK, "not checked, since no joint limits are given")
    found, severe = [], False
    for index, name in enumerate(table.joint_names):
        low, high = limits[index]
        slack = OUTSIDE * (high - low) if np.isfinite(high - low) else 0.0
        outside = float(
            np.mean((table.position[:, index] < low - slack) | (table.position[:, index] > high + slack))
        )
        if outside > 0.01:
            span = f"{np.nanmin(table.position[:, index]):.3g}..{np.nanmax(table.position[:, index]):.3g}"
            found.append(f"{name} {outside:.0%} of the time ({span}, the model has {low:.3g}..{high:.3g})")
            severe |= outside > 0.5
    held = table.target_at(table.time_s)
    far = [
        f"{name} {reach:.3g} rad"
        for column, (name, index) in enumerate(zip(table.actuated, table.actuated_index, strict=True))
        if table.units[index] == "rad"
        and not np.isfinite(limits[index]).all()
        # The position of a wheel does not follow its effort.
        and _correlation(held[:, column], table.position[:, index]) > FOLLOWS
        and (reach := float(np.nanmax(np.abs(table.position[:, index])))) > FURTHEST
    ]
    if not found and far:
        text = (
            f"joints without limits that turn more than once: {', '.join(far)}; check whether they are "
            "in degrees"
        )
        return _verdict("limits", Severity.WARN, text)
    if not found:
        return _verdict("limits", Severity.OK, "positions lie inside the model's limits")
    text = (
        f"positions outside the model's limits: {', '.join(found)}; check zero (offset), sign, unit and "
        "joint order. If these are right, the model's range is too narrow and its end stop pushes in "
        "every prediction: widen it"
    )
    return _verdict("limits", Severity.FAIL if severe else Severity.WARN, text)


def _at_extreme(values: FloatArray) -> float:
    """Return the share of samples exactly at an extreme of a continuous signal; 0 for a stepped one."""
    if np.unique(values).size < 50:
        return 0.0
    return float(max(np.mean(values == np.max(values)), np.mean(values == np.min(values))))


def _clipped_commands(table: Table, limits: FloatArray | None) -> Finding:
    held, found = table.target_at(table.time_s), []
    for column, (index, name) in enumerate(zip(table.actuated_index, table.actuated, strict=True)):
        share = _at_extreme(held[:, column])
        if limits is not None and np.isfinite(limits[index]).all():
            low, high = limits[index]
            share = max(
                share * (share > FLAT), float(np.mean((held[:, column] <= low) | (held[:, column] >= high)))
            )
        if share > FLAT / 2:
            found.append(f"{name} {share:.0%}")
    if not found:
        return _verdict("clamped", Severity.OK, "commands are not clamped")
    text = (
        f"commands stay at their extreme: {', '.join(found)} of the time; check that the recorded target "
        "is the clamped one"
    )
    return _verdict("clamped", Severity.WARN, text)


def _saturated_effort(table: Table) -> Finding:
    if table.effort is None:
        return _verdict("saturated", Severity.OK, "no effort recorded")
    found = [
        f"{name} {share:.0%}"
        for name, column in zip(table.joint_names, np.abs(table.effort).T, strict=True)
        if np.isfinite(column).all() and np.max(column) > 0
        if (share := float(np.mean(column >= 0.999 * np.max(column)))) > FLAT / 2
        and np.unique(column).size > 5
    ]
    if not found:
        return _verdict("saturated", Severity.OK, "effort does not saturate")
    text = f"effort stays at its highest value: {', '.join(found)} of the time; the effort limit was active"
    return _verdict("saturated", Severity.WARN, text)


def _excitation(table: Table) -> Finding:
    spans = [_span(column) for column in table.position.T]
    weak = [
        f"{name} {span:.2g} {unit}"
        for name, span, unit in zip(table.joint_names, spans, table.units, strict=True)
        if span < 5 * MOVES[unit]
    ]
    if len(weak) == len(spans):
        text = (
            f"every joint moves too little to estimate its parameters ({', '.join(weak)}); record larger "
            "motions"
        )
        return _verdict("excitation", Severity.FAIL, text)
    if weak:
        return _verdict(
            "excitation", Severity.WARN, f"little motion: {', '.join(weak)}; record larger motions of these"
        )
    return _verdict("excitation", Severity.OK, "every joint moves enough")


def _quaternion(table: Table) -> Finding:
    values = np.asarray(table.orientation)
    off = float(np.max(np.abs(np.linalg.norm(values, axis=1) - 1)))
    if not off < 0.02:
        return _verdict(
            "orientation",
            Severity.FAIL,
            f"quaternions of norm 1 +- {off:.2g}, but it must be 1; check the columns",
        )
    if np.mean(np.abs(values[:, 0])) < 0.3 and np.mean(np.abs(values[:, 3])) > 0.9:
        text = (
            "the base seems to be turned by half a turn about its own z axis all the time; the order may "
            "be xyzw: set `order` in the column map"
        )
        return _verdict("orientation", Severity.WARN, text)
    return _verdict("orientation", Severity.OK, "unit quaternions")


def _span(values: FloatArray) -> float:
    """Return the range of a channel without its outermost percentiles."""
    low, high = np.nanpercentile(values, [1, 99])
    return float(high - low)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    if np.std(a[both]) == 0 or np.std(b[both]) == 0:
        return 0.0
    return float(np.corrcoef(a[both], b[both])[0, 1])
