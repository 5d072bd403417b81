"""Guesses a column map from the message types of a ROS 2 bag: the topics of measurements and commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.columns import ColumnMap, JointColumns, TimeColumn
from deal_hw.data.importing.guess import is_target, match_joints
from deal_hw.errors import DatasetError, short

STATES: Mapping[str, str] = {"JointState": "position"}
"""Message type -> its field with the measured positions."""
CONTROLLER_STATES: Mapping[str, tuple[str, ...]] = {
    "JointTrajectoryControllerState": ("reference.positions", "desired.positions"),
}
"""Message type -> fields with a controller's actual reference for its servos, the newer one first."""
COMMANDS: Mapping[str, str] = {
    "JointState": "position",
    "JointTrajectory": "points.positions",
    "MultiDOFCommand": "values",
    "Float64MultiArray": "data",
    "Float32MultiArray": "data",
}
"""Message type -> its field with the commands."""


def guess_topics(channels: Channels, joints: Sequence[str] | None = None) -> ColumnMap | None:
    """Guess which topics of a bag contain a robot's measurements and commands.

    Measurements: a ``sensor_msgs/JointState`` without a word for a command in its topic. Commands: the
    reference in a controller's state; else a command topic of a type in :data:`COMMANDS`. Commands without
    names have the order of the measured joints. Times are those of the headers if both topics have them, else
    those of the recorder.

    Args:
        channels: The bag's channels.
        joints: Names of the model's joints; None: the bag's names.

    Returns:
        None if no topic has a known type of measurement.

    Raises:
        DatasetError: Several topics are possible, or none has commands; the message shows what to write in a
            column map.
    """
    states = {
        topic: f"{topic}.{field}"
        for topic, kind in channels.types.items()
        if (field := STATES.get(_plain(kind)))
        and not is_target(topic)
        and channels.is_wide(f"{topic}.{field}")
    }
    if not states:
        return None
    state = _only(channels, states, joints, "measured positions", "position")
    topic, array = state, states[state]
    names = list(channels.labels.get(array, ()))
    found = match_joints(channels, names, joints)
    commands = _commands(channels, array, names, len(found))
    command = _only(channels, commands, names, "commands", "target")
    target = commands[command]
    by_order = target not in channels.labels
    # A controller of those of the measured joints that the model has, in their order.
    of_some = by_order and channels.arrays[target].shape[1] < len(names)
    time, command_time = _times(channels, topic, command)
    same = channels.arrays[array].shape
    velocity, effort = (
        name if name in channels.arrays and channels.arrays[name].shape == same else None
        for name in (f"{topic}.velocity", f"{topic}.effort")
    )
    return ColumnMap(
        time=time,
        command_time=command_time,
        position=array,
        target=target,
        velocity=velocity,
        effort=effort,
        joints=tuple(
            JointColumns(
                name=model,
                column=name,
                index=index if by_order and not of_some else None,
                target=f"{target}[{place}]" if of_some else None,
            )
            for place, (model, name, index) in enumerate(found)
        ),
        source=("guessed",),
    )


def _plain(kind: str) -> str:
    return kind.rpartition("/")[2]


def _commands(channels: Channels, state: str, names: Sequence[str], known: int) -> dict[str, str]:
    """Return the topics that may contain the commands, with their channels; of the best kind only."""
    reference: dict[str, str] = {}
    others: dict[str, str] = {}
    segments = []
    for topic, kind in channels.types.items():
        for field in CONTROLLER_STATES.get(_plain(kind), ()):
            if channels.is_wide(f"{topic}.{field}"):
                reference.setdefault(topic, f"{topic}.{field}")
        name = f"{topic}.{COMMANDS.get(_plain(kind), '')}"
        if _plain(kind) == "JointTrajectory" and name not in channels.arrays:
            segments.append(topic)
        named = name in channels.labels and bool(set(channels.labels[name]) & set(names))
        ordered = channels.is_wide(name) and name not in channels.labels and is_target(topic)
        fits = ordered and channels.arrays[name].shape[1] in (len(names), known)
        if (named and name != state and (is_target(topic) or _plain(kind) != "JointState")) or fits:
            others[topic] = name
    if reference or others:
        return reference or others
    if segments:
        raise DatasetError(
            f"{channels.path}: {short(', '.join(segments), 80)} contains trajectories of several points, "
            "which the controller interpolates; the commands of the servos are in its state. Record that "
            "topic, too, such as /joint_trajectory_controller/controller_state"
        )
    listed = ", ".join(f"{topic} ({_plain(kind)})" for topic, kind in channels.types.items())
    raise DatasetError(
        f"{channels.path}: no topic contains commands for {short(', '.join(names), 80)}; topics: "
        f"{short(listed, 120)}. Record the controller's commands too (ros2 bag record ... "
        f"/position_controller/commands), or name their channel: {_entries(state, '/TOPIC.data')}"
    )


def _only(
    channels: Channels, found: Mapping[str, str], wanted: Sequence[str] | None, what: str, entry: str
) -> str:
    """Return the only topic, or the only one with the model's joints."""
    if len(found) > 1 and wanted is not None:
        fitting = [topic for topic, name in found.items() if set(channels.labels.get(name, ())) & set(wanted)]
        if len(fitting) == 1:
            return fitting[0]
    if len(found) > 1:
        listed = "; ".join(
            f"{name}: {', '.join(channels.labels.get(name, ())) or 'no names'}" for name in found.values()
        )
        first = next(iter(found.values()))
        example = (
            _entries(first, "/TOPIC.FIELD") if entry == "position" else _entries("/TOPIC.position", first)
        )
        raise DatasetError(
            f"{channels.path}: {len(found)} topics may contain the {what} ({short(listed, 160)}); choose "
            f"one in a column map, such as {example}"
        )
    return next(iter(found))


def _entries(position: str, target: str) -> str:
    """Return the lines of a column map, on one line, for a message."""
    topics = [name.partition(".")[0] for name in (position, target)]
    entries = {
        "time": f"{topics[0]}.log_time",
        "command_time": f"{topics[1]}.log_time",
        "position": position,
        "target": target,
        "joints": "[NAME, ...]",
    }
    return short("{" + ", ".join(f"{key}: {value}" for key, value in entries.items()) + "}", 240)


def _times(channels: Channels, state: str, command: str) -> tuple[TimeColumn, TimeColumn]:
    """Return times on one clock: the headers' if both topics set them and overlap, else the recorder's."""
    ends = []
    for topic in (state, command):
        stamp = channels.arrays.get(f"{topic}.header.stamp", np.zeros(1))
        ends.append((float(stamp.min()), float(stamp.max())))
    moving = all(end > begin for begin, end in ends)
    overlap = min(end for _, end in ends) > max(begin for begin, _ in ends)
    field = "header.stamp" if moving and overlap else "log_time"
    return TimeColumn(column=f"{state}.{field}"), TimeColumn(column=f"{command}.{field}")
