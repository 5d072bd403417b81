"""Checks whether the channels of a recording of others are what their names say.

They find the usual errors of such logs: degrees for radians, joints in another order or with another sign, a
target that is a copy of the measurement, commands on another clock.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.data.checks.samples import MOVES
from deal_hw.data.checks.slip import slip_verdict
from deal_hw.data.table import Table
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray

FAR = {"rad": 1.0, "m": 0.2}
"""A position that is always farther from its command than this is reported [rad or m]."""
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


def check_commands(table: Table, efforts: bool) -> Finding:
    """Check that commands change, on the clock of the samples."""
    if not table.command_s.size:
        text = (
            "no commanded positions, so nothing can be predicted; name them as `target` in the column map. "
            "If a policy moved the robot, calibrate --policy FILE.onnx computes its commands. "
            "If the joints swing freely with their servos off, remove the actuators from a copy of the MJCF"
        )
        return Finding("commands", Severity.FAIL, text)
    begin, end = float(table.command_s[0]), float(table.command_s[-1])
    inside = min(end, table.time_s[-1]) - max(begin, table.time_s[0])
    text = f"{table.command_s.size} commands from {begin:.4g} s to {end:.4g} s"
    if inside < 0.5 * min(end - begin, table.time_s[-1]):
        text = (
            f"{text}, samples from 0 s to {table.time_s[-1]:.4g} s; check that both have one clock and the "
            "right unit"
        )
        return Finding("commands", Severity.FAIL, text)
    still = [
        name for name, span in zip(table.actuated, np.ptp(table.target, axis=0), strict=True) if span == 0
    ]
    if len(still) == len(table.actuated) and not efforts:
        return Finding("commands", Severity.FAIL, f"{text}; no command ever changes: record a motion")
    moved = {name: _span(table.position[:, table.joint_names.index(name)]) for name in still}
    moved = {
        name: span
        for name, span in moved.items()
        if span > 5 * MOVES[table.units[table.joint_names.index(name)]]
    }
    if moved and not efforts:
        each = ", ".join(
            f"{name} (moves over {span:.3g} {table.units[table.joint_names.index(name)]})"
            for name, span in moved.items()
        )
        return Finding(
            "commands",
            Severity.WARN,
            f"the command never changes although the joint moves: {each}",
            "check that the column has its command; if it was moved by hand or by other joints, all is well",
        )
    return Finding("commands", Severity.OK, text)


def check_copy(table: Table) -> Finding:
    """Check that measured positions are no copy of the commands, nor commands one of earlier positions."""
    held, measured = table.target_at(table.time_s), table.position[:, list(table.actuated_index)]
    copied, echoed = [], []
    for column, name in enumerate(table.actuated):
        if (lag := _copied(held[:, column], measured[:, column])) is not None:
            copied.append(f"{name}, {lag} samples later" if lag else name)
        elif (lag := _copied(measured[:, column], held[:, column])) is not None:
            echoed.append(f"{name}, {lag} samples later")
    if echoed:
        text = (
            f"commands that are a copy of the measured position: {', '.join(echoed)}; such a command follows "
            "the motion and cannot have caused it: name the column of the commands that were sent"
        )
        return Finding("copy", Severity.FAIL, text)
    if not copied:
        return Finding("copy", Severity.OK, "measured and commanded positions differ")
    text = (
        f"measured positions that are a copy of the command: {', '.join(copied)}; one of the two channels "
        "is wrong: correct the column map"
    )
    return Finding("copy", Severity.FAIL, text)


def _copied(first: FloatArray, second: FloatArray) -> int | None:
    """Return after how many samples a moving channel repeats another one, 0 to 5; None if it does not."""
    for lag in range(6):
        ahead, behind = first[: len(first) - lag], second[lag:]
        moving = np.abs(np.diff(behind, prepend=behind[0])) > 0
        if np.sum(moving) > 20 and np.mean(np.abs(ahead - behind)[moving] < 1e-7) > 0.9:
            return lag
    return None


def check_slip(table: Table) -> Finding:
    """Check that one delay holds for the whole recording."""
    # The clock's check reports repeated stamps; here the first of each counts.
    new = np.concatenate([[True], np.diff(table.time_s) > 0])
    return slip_verdict(
        table.time_s[new], table.position[new], table.command_s, table.target, np.array(table.actuated_index)
    )


FACTORS = {DEGREES: "degrees for radians", 1000.0: "millimetres for metres"}
"""Ratios of two units that are mistaken for each other, and their names."""


def check_units(table: Table, limits: FloatArray | None) -> tuple[Finding, bool]:
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
            for factor in FACTORS
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
        f"{', '.join(names)}: {words} ({FACTORS[factor]})" for (words, factor), names in alike_factor.items()
    ] + found
    found += _beyond_limits(table, limits, explained)
    if found:
        text = f"{'; '.join(found)}. Give the unit in the column map (unit, target_unit, normalised)"
        return Finding("units", Severity.FAIL, text), bool(explained)
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
        return Finding("units", Severity.WARN, text), False
    return Finding("units", Severity.OK, "ranges of commands and measurements agree"), False


def check_levels(table: Table) -> Finding:
    """Check that positions are near their commands."""
    held, found = table.target_at(table.time_s), []
    for column, index in enumerate(table.actuated_index):
        off = float(np.nanmedian(table.position[:, index] - held[:, column]))
        span = max(_span(table.position[:, index]), _span(held[:, column]))
        if abs(off) > max(FAR[table.units[index]], 3 * span):
            found.append(f"{table.joint_names[index]} {off:+.3g} {table.units[index]}")
    if not found:
        return Finding("levels", Severity.OK, "measurements are near their commands")
    text = f"measurements are far from their commands all the time: {', '.join(found)}"
    return Finding(
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


def check_limits(table: Table, limits: FloatArray | None) -> Finding:
    """Check that positions lie inside the model's limits."""
    if limits is None:
        return Finding("limits", Severity.OK, "not checked, since no joint limits are given")
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
        return Finding("limits", Severity.WARN, text)
    if not found:
        return Finding("limits", Severity.OK, "positions lie inside the model's limits")
    text = (
        f"positions outside the model's limits: {', '.join(found)}; check zero (offset), sign, unit and "
        "joint order. If these are right, the model's range is too narrow and its end stop pushes in "
        "every prediction: widen it"
    )
    return Finding("limits", Severity.FAIL if severe else Severity.WARN, text)


def _at_extreme(values: FloatArray) -> float:
    """Return the share of samples exactly at an extreme of a continuous signal; 0 for a stepped one."""
    if np.unique(values).size < 50:
        return 0.0
    return float(max(np.mean(values == np.max(values)), np.mean(values == np.min(values))))


def check_clipping(table: Table, limits: FloatArray | None) -> Finding:
    """Check for commands that stay at their extreme."""
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
        return Finding("clamped", Severity.OK, "commands are not clamped")
    text = (
        f"commands stay at their extreme: {', '.join(found)} of the time; check that the recorded target "
        "is the clamped one"
    )
    return Finding("clamped", Severity.WARN, text)


def check_saturation(table: Table) -> Finding:
    """Check for efforts that stay at their highest value."""
    if table.effort is None:
        return Finding("saturated", Severity.OK, "no effort recorded")
    found = [
        f"{name} {share:.0%}"
        for name, column in zip(table.joint_names, np.abs(table.effort).T, strict=True)
        if np.isfinite(column).all() and np.max(column) > 0
        if (share := float(np.mean(column >= 0.999 * np.max(column)))) > FLAT / 2
        and np.unique(column).size > 5
    ]
    if not found:
        return Finding("saturated", Severity.OK, "effort does not saturate")
    text = f"effort stays at its highest value: {', '.join(found)} of the time; the effort limit was active"
    return Finding("saturated", Severity.WARN, text)


def check_excitation(table: Table) -> Finding:
    """Check that the joints move enough."""
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
        return Finding("excitation", Severity.FAIL, text)
    if weak:
        return Finding(
            "excitation", Severity.WARN, f"little motion: {', '.join(weak)}; record larger motions of these"
        )
    return Finding("excitation", Severity.OK, "every joint moves enough")


def check_orientation(values: FloatArray) -> Finding:
    """Check quaternions w x y z, (T, 4)."""
    off = float(np.max(np.abs(np.linalg.norm(values, axis=1) - 1)))
    if not off < 0.02:
        return Finding(
            "orientation",
            Severity.FAIL,
            f"quaternions of norm 1 +- {off:.2g}, but it must be 1; check the columns",
        )
    if np.mean(np.abs(values[:, 0])) < 0.3 and np.mean(np.abs(values[:, 3])) > 0.9:
        text = (
            "the base seems to be turned by half a turn about its own z axis all the time; the order may "
            "be xyzw: set `order` in the column map"
        )
        return Finding("orientation", Severity.WARN, text)
    return Finding("orientation", Severity.OK, "unit quaternions")


def _span(values: FloatArray) -> float:
    """Return the range of a channel without its outermost percentiles."""
    low, high = np.nanpercentile(values, [1, 99])
    return float(high - low)


def _correlation(a: FloatArray, b: FloatArray) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    if np.std(a[both]) == 0 or np.std(b[both]) == 0:
        return 0.0
    return float(np.corrcoef(a[both], b[both])[0, 1])
