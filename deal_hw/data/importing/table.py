"""Makes a table of a file's channels, as a column map names them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import POSITION_UNITS, TIME_UNITS, ColumnMap, JointColumns, Vector
from deal_hw.data.importing.guess import guess_time, unguessed
from deal_hw.data.table import Table
from deal_hw.errors import DatasetError, short
from deal_hw.rotations import rotated
from deal_hw.types import FloatArray

_QUANTITIES = ("pos", "position", "vel", "velocity", "effort", "torque")


def build_table(channels: Channels, columns: ColumnMap, joints: Sequence[str] | None = None) -> Table:
    """Pick and convert the channels that a column map names; angles that wrap are unwrapped.

    Rows without any position are left out (they occur in logs with several rates), and so are rows without
    any target; ``source`` counts both.

    Args:
        channels: The file's channels.
        columns: Their meaning.
        joints: Names of the model's joints: the table follows their order, and others are refused. None: the
        map's order.

    Raises:
        DatasetError: A channel is missing or does not fit the others, or a joint is not the model's.
    """
    ordered = _ordered(channels, columns, joints)
    time_s, command_s = _times(channels, columns)
    measured = {
        kind: [joint_channel(channels, columns, joint, place, kind) for joint, place in ordered]
        for kind in ("position", "velocity", "effort", "target")
    }
    absent = [
        joint.name for (joint, _), values in zip(ordered, measured["position"], strict=True) if values is None
    ]
    if absent:
        raise DatasetError(
            f"{channels.path}: no position of {', '.join(absent)}; give `position` in the column map"
        )
    position = _stack(channels, "position", measured["position"], time_s.size)
    velocity = _stack(channels, "velocity", measured["velocity"], time_s.size)
    effort = _stack(channels, "effort", measured["effort"], time_s.size)
    actuated = [
        joint for (joint, _), values in zip(ordered, measured["target"], strict=True) if values is not None
    ]
    targets = [values for values in measured["target"] if values is not None]
    target = _stack(channels, "target", targets, command_s.size, columns.command_time is not None)
    if position is None:
        raise DatasetError(f"{channels.path}: the column map names no position")
    if target is None:
        command_s, target = np.empty(0), np.empty((0, 0))
    orientation, gyro = _orientation(channels, columns.orientation), _triple(channels, "gyro", columns.gyro)
    place = _triple(channels, "base_position", columns.base_position)
    speed = _triple(channels, "base_velocity", columns.base_velocity)
    of_base = {"orientation": orientation, "gyro": gyro, "base_position": place, "base_velocity": speed}
    for name, values in of_base.items():
        if values is not None and len(values) != time_s.size:
            raise DatasetError(f"{channels.path}: {name} has {len(values)} rows, time has {time_s.size}")
    if speed is not None and columns.base_velocity is not None and columns.base_velocity.frame == "base":
        speed = _in_world(channels, speed, orientation)
    kept = np.asarray(~np.isnan(position).all(axis=1))
    sent = ~np.isnan(target).all(axis=1) if target.size else np.zeros(command_s.size, dtype=bool)
    if not kept.any():
        raise DatasetError(f"{channels.path}: every position is empty; check the channel in the column map")
    zero_s = float(time_s[kept][0])
    position, target, turns = _unwrapped(
        [joint for joint, _ in ordered], actuated, time_s, position, command_s, target
    )
    return Table(
        joint_names=tuple(joint.name for joint, _ in ordered),
        actuated=tuple(joint.name for joint in actuated),
        units=tuple(joint.si_unit for joint, _ in ordered),
        time_s=time_s[kept] - zero_s,
        position=position[kept],
        velocity=None if velocity is None else velocity[kept],
        effort=None if effort is None else effort[kept],
        command_s=command_s[sent] - zero_s,
        target=target[sent],
        orientation=None if orientation is None else orientation[kept],
        gyro=None if gyro is None else gyro[kept],
        base_position=None if place is None else place[kept],
        base_velocity=None if speed is None else speed[kept],
        source={
            "file": channels.path.name,
            "part": channels.part,
            "kind": channels.kind,
            "sha256": channels.digest,
            "columns": list(columns.source),
            "notes": list(channels.notes),
            "rows_without_position": int(np.sum(~kept)),
            "rows_without_target": int(np.sum(~sent)),
            **({"unwrapped": turns} if turns else {}),
        },
    )


def _unwrapped(
    joints: Sequence[JointColumns],
    actuated: Sequence[JointColumns],
    time_s: FloatArray,
    position: FloatArray,
    command_s: FloatArray,
    target: FloatArray,
) -> tuple[FloatArray, FloatArray, dict[str, int]]:
    """Return positions (T, J) and targets (C, A) without jumps by full turns, and how many each joint had.

    A commanded angle gets the turns that bring it nearest to the measured one.
    """
    position, target, turns = position.copy(), target.copy(), {}
    for j, joint in enumerate(joints):
        if joint.si_unit == "rad":
            position[:, j], count = unwrap(position[:, j], time_s)
            if count:
                turns[joint.name] = count
    for a, joint in enumerate(actuated):
        if joint.name in turns and not joint.takes_effort:
            measured = position[:, joints.index(joint)]
            sound = np.isfinite(measured) & np.isfinite(time_s)
            near = np.interp(command_s, time_s[sound], measured[sound])
            target[:, a] = nearest_turn(target[:, a], near)
    return position, target, turns


def _ordered(
    channels: Channels, columns: ColumnMap, joints: Sequence[str] | None
) -> list[tuple[JointColumns, int]]:
    """Return the map's joints in the model's order, each with its place in the map."""
    placed = {joint.name: (joint, place) for place, joint in enumerate(columns.joints)}
    if joints is None:
        return list(placed.values())
    unknown = [name for name in placed if name not in joints]
    if unknown:
        raise DatasetError(
            f"{channels.path}: the column map names {', '.join(unknown)}, which the model does not have; "
            f"its joints: {', '.join(joints)}"
        )
    return [placed[name] for name in joints if name in placed]


def _times(channels: Channels, columns: ColumnMap) -> tuple[FloatArray, FloatArray]:
    """Return the stamps of samples and commands since the first sample, (T,) and (C,) [s]."""
    time = columns.time or guess_time(channels)
    if time is None:
        raise unguessed(channels, "which channel is the time")
    raw, unit = channels.column(time.column), TIME_UNITS[time.unit]
    finite = raw[np.isfinite(raw)]
    # The first one is subtracted before scaling: an epoch in ns times 1e-9 has a resolution of only 0.2 us.
    zero = float(finite[0]) if finite.size else 0.0
    time_s = (raw - zero) * unit
    if columns.command_time is None:
        return time_s, time_s + columns.command_shift_s
    its_unit = TIME_UNITS[columns.command_time.unit]
    return time_s, (
        channels.column(columns.command_time.column) - zero * (unit / its_unit)
    ) * its_unit + columns.command_shift_s


def joint_channel(
    channels: Channels, columns: ColumnMap, joint: JointColumns, place: int, kind: str
) -> FloatArray | None:
    """Return one quantity of one joint in SI, (T,); None if the map or the file has none."""
    given: str | None = getattr(joint, kind)
    pattern: str | None = getattr(columns, kind) if given is None else given
    if pattern is None or pattern.lower() in ("", "none"):
        return None
    if given is not None or "{joint}" in pattern:
        values = channels.column(pattern.replace("{joint}", joint.column or joint.name))
    else:
        found = _from_array(channels, pattern, columns, joint, place, kind)
        if found is None:
            return None
        values = found
    slope, constant = joint.scale(target=kind == "target")
    if kind in ("position", "target"):
        return slope * values + constant
    return (slope if kind == "velocity" else joint.sign) * values


def _from_array(
    channels: Channels, name: str, columns: ColumnMap, joint: JointColumns, place: int, kind: str
) -> FloatArray | None:
    """Return a joint's column: by its index, else by its label, or without labels by its place."""
    values = channels.array(name)
    if values.ndim == 1:
        if len(columns.joints) == 1:
            return values
        raise DatasetError(
            f"{channels.path}: {name!r} is one channel but there are {len(columns.joints)} joints; "
            "write a pattern with {joint}"
        )
    labels = [_plain(label) for label in channels.labels.get(name, ()) or channels.joint_names]
    if joint.index is None and labels:
        return _by_label(channels, name, labels, columns, joint, kind)
    if joint.index is None and joint.column:
        raise DatasetError(
            f"{channels.path}: the column map names {short(joint.column)!r} for joint {joint.name!r}, but "
            f"the {values.shape[1]} columns of {name!r} have no names; give `index` (from 0) instead"
        )
    index = place if joint.index is None else joint.index
    if index >= values.shape[1]:
        raise DatasetError(
            f"{channels.path}: {name!r} has {values.shape[1]} columns, joint {joint.name!r} would be number "
            f"{index}; list the joints in the order of the array, or give each its index"
        )
    return values[:, index]


def _by_label(
    channels: Channels, name: str, labels: Sequence[str], columns: ColumnMap, joint: JointColumns, kind: str
) -> FloatArray | None:
    """Return the column of that name; None if only other joints of the map have one, such as a target."""
    values, own = channels.array(name), _plain(joint.column or joint.name)
    if len(labels) != values.shape[1]:
        raise DatasetError(
            f"{channels.path}: {name!r} has {values.shape[1]} columns, and the file names {len(labels)} "
            f"({short(', '.join(labels))}); give each joint its `index` (from 0) in the column map"
        )
    if labels.count(own) == 1:
        return values[:, labels.index(own)]
    asked = [_plain(other.column or other.name) for other in columns.joints if other.index is None]
    if kind != "position" and own not in labels and any(other in labels for other in asked):
        return None
    known = "several" if own in labels else "none"
    raise DatasetError(
        f"{channels.path}: the column map asks for {short(own)!r} in {name!r}, which has {known} of that "
        f"name; its columns: {short(', '.join(labels))}. Name one of them (`column`), or its `index` (from 0)"
    )


def _plain(label: str) -> str:
    """Return a label without the quantity that LeRobot appends, as in elbow.pos."""
    stem, _, quantity = label.rpartition(".")
    return stem if stem and quantity in _QUANTITIES else label


def _stack(
    channels: Channels, kind: str, columns: Sequence[FloatArray | None], rows: int, own_time: bool = False
) -> FloatArray | None:
    """Return the joints' channels as (T, J), or None; a joint without a channel is NaN."""
    present = [values for values in columns if values is not None]
    if not present:
        return None
    sizes = {values.size for values in present}
    if sizes != {rows}:
        hint = (
            ""
            if own_time or kind != "target"
            else "; give `command_time` if commands have stamps of their own"
        )
        raise DatasetError(
            f"{channels.path}: {kind} has {sorted(sizes)} rows, but its time has {rows}; both need the "
            f"same number{hint}"
        )
    return np.stack([np.full(rows, np.nan) if values is None else values for values in columns], axis=1)


def _vector(channels: Channels, vector: Vector) -> FloatArray:
    if len(vector.columns) == 1:
        return channels.array(vector.columns[0])
    return np.stack([channels.column(name) for name in vector.columns], axis=1)


def _orientation(channels: Channels, vector: Vector | None) -> FloatArray | None:
    if vector is None:
        return None
    values = _vector(channels, vector)
    if values.ndim != 2 or values.shape[1] != 4:
        raise DatasetError(
            f"{channels.path}: orientation has shape {values.shape}; a quaternion has 4 columns"
        )
    return values[:, [3, 0, 1, 2]] if vector.order == "xyzw" else values


def _triple(channels: Channels, name: str, vector: Vector | None) -> FloatArray | None:
    """Return a vector of three channels in SI, (T, 3), or None."""
    if vector is None:
        return None
    values = _vector(channels, vector)
    if values.ndim != 2 or values.shape[1] != 3:
        raise DatasetError(f"{channels.path}: {name} has shape {values.shape}; it has 3 columns, x y z")
    return POSITION_UNITS[vector.unit] * values


def _in_world(channels: Channels, velocity: FloatArray, orientation: FloatArray | None) -> FloatArray:
    """Return a base's velocity, (T, 3), which has the base's axes, with those of the world."""
    if orientation is None:
        raise DatasetError(
            f"{channels.path}: base_velocity has the base's axes, and there is no orientation to turn them; "
            "name it in the column map"
        )
    return rotated(orientation, velocity)


TURN = 2 * np.pi
WIDEST = 1.02
"""A folded angle lies within this many turns; noise at the seam may reach beyond one."""
FEWEST = 20
"""Fewer samples show no motion that a jump could be compared with."""
FASTEST, USUAL = np.pi / 2, 0.9
"""If less than this share of the steps is shorter, a jump says little [rad]."""
GAP_PERIODS = 3.0
"""Steps over a longer pause say nothing of the motion [sampling periods]."""
NEIGHBOURS = 4
"""Steps on each side of a jump that tell how fast the joint moves there."""
FASTER = 3.0
"""Without its full turn, a jump is no longer than this many times the longest step around it ..."""
REST_RAD = 0.1
"""... or than this: noise and the first step of a motion, where the joint was at rest [rad]."""


def unwrap(angle: FloatArray, time_s: FloatArray) -> tuple[FloatArray, int]:
    """Return an angle without jumps by full turns, and how many there were.

    A jump of more than half a turn counts if a full turn less leaves a step like those around it, per time.
    Other jumps of that size stay: spikes and faults, for the checks to name. If there are more of these, or
    the angle goes beyond one turn, or few steps are well below half a turn, all is returned as it is.

    Args:
        angle: (T,) [rad]; what is not finite stays.
        time_s: Stamps, (T,) [s].
    """
    sound = np.flatnonzero(np.isfinite(angle) & np.isfinite(time_s))
    values = angle[sound]
    if values.size < FEWEST or np.ptp(values) > WIDEST * TURN:
        return angle, 0
    steps = np.diff(values)
    jumps = np.flatnonzero(np.abs(steps) > np.pi)
    if not jumps.size:
        return angle, 0
    turns = np.round(steps / TURN)
    left = np.abs(steps - turns * TURN)
    elapsed = np.maximum(np.diff(time_s[sound]), 1e-9)
    if np.quantile(left[elapsed <= GAP_PERIODS * np.median(elapsed)], USUAL) > FASTEST:
        return angle, 0
    rate = left / elapsed
    # One jump does not vouch for another: a spike is two.
    rate[jumps] = 0.0
    folds = []
    for at in jumps:
        before, after = rate[max(at - NEIGHBOURS, 0) : at], rate[at + 1 : at + 1 + NEIGHBOURS]
        fastest = max(float(np.max(side, initial=0.0)) for side in (before, after))
        if left[at] <= FASTER * fastest * elapsed[at] + REST_RAD:
            folds.append(at)
    if 2 * len(folds) <= jumps.size:
        return angle, 0
    counted = np.zeros(steps.size)
    counted[folds] = turns[folds]
    found = angle.copy()
    found[sound] = values - TURN * np.concatenate(([0.0], np.cumsum(counted)))
    return found, len(folds)


def nearest_turn(angle: FloatArray, near: FloatArray) -> FloatArray:
    """Return angles with whole turns added so that each is within half a turn of another, (N,) both."""
    return np.asarray(angle + TURN * np.round((near - angle) / TURN))
