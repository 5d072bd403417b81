"""Reads ROS 2 messages from an MCAP file into channels ``/topic.field``."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from deal_hw.data.importing.channels import Channels, as_floats, digest_of_file
from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray

STAMP_FIELDS = ("log_time", "header.stamp")
"""Times of each topic [s]: when the recorder got the message, and when the sender says it was made."""


def read_mcap(path: Path) -> Channels:
    """Read all numbers of all topics.

    A message such as ``sensor_msgs/msg/JointState`` on ``/joint_states`` gives ``/joint_states.position``
    (T, K) with the names of its field ``name`` as labels, whatever order single messages have,
    ``/joint_states.log_time`` and ``/joint_states.header.stamp`` (T,) [s], both on one zero. Nested fields
    are joined by dots: ``/imu.orientation.w``.

    Raises:
        DatasetError: It cannot be read, or the messages of one topic differ in their joints.
    """
    path = Path(path)
    digest = digest_of_file(path)
    topics: dict[str, list[dict[str, Any]]] = {}
    try:
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages():
                row = dict(_fields(decoded))
                row["log_time"] = message.log_time
                topics.setdefault(channel.topic, []).append(row)
    except (OSError, McapError, struct.error, ValueError, EOFError) as error:
        raise DatasetError(
            f"{path} cannot be read as MCAP with ROS 2 messages: {str(error) or type(error).__name__}; "
            "if it was cut off, `mcap recover` mends it"
        ) from error
    arrays: dict[str, FloatArray] = {}
    labels: dict[str, tuple[str, ...]] = {}
    zero_ns = _first_stamp(topics)
    for topic, rows in topics.items():
        names = _names(path, topic, rows)
        for field in rows[0]:
            values = _channel(rows, field, names, zero_ns)
            if values is not None:
                arrays[f"{topic}.{field}"] = values
                if names and values.ndim == 2 and values.shape[1] == len(names):
                    labels[f"{topic}.{field}"] = names
    return Channels(path=path, kind="mcap", digest=digest, arrays=arrays, labels=labels)


def _fields(message: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a decoded message by dotted name; a stamp is one leaf, in integer ns."""
    for slot in message.__slots__:
        value = getattr(message, slot)
        name = f"{prefix}{slot}"
        if hasattr(value, "__slots__"):
            parts = tuple(value.__slots__)
            if parts[-2:] == ("sec", "nanosec"):
                yield name, int(value.sec) * 10**9 + int(value.nanosec)
            else:
                yield from _fields(value, f"{name}.")
        elif isinstance(value, (bool, int, float)) or _is_list(value):
            yield name, value


def _is_list(value: Any) -> bool:
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        return False
    return len(value) == 0 or isinstance(value[0], (int, float, str, np.number))


def _first_stamp(topics: dict[str, list[dict[str, Any]]]) -> int:
    """Return the earliest stamp in the file [ns], the zero of all.

    It is taken off in integers: absolute nanoseconds would lose their last digits as floats.
    """
    every = (row for rows in topics.values() for row in rows)
    return min((row[kind] for row in every for kind in STAMP_FIELDS if row.get(kind, 0) > 0), default=0)


def _names(path: Path, topic: str, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return the joints of a topic in the order of its first message; () where it names none."""
    first: Any = rows[0].get("name")
    if not _is_list(first) or not all(isinstance(name, str) for name in first):
        return ()
    names = tuple(first)
    for number, row in enumerate(rows):
        if set(row["name"]) != set(names):
            raise DatasetError(
                f"{path}: message {number} on {topic} names the joints {sorted(row['name'])}, the first one "
                f"{sorted(names)}; record each publisher on a topic of its own"
            )
    return names


def _channel(
    rows: list[dict[str, Any]], field: str, names: tuple[str, ...], zero_ns: int
) -> FloatArray | None:
    """Return one field of all messages, (T,) or (T, K); None where it is not numbers of one length."""
    if field in STAMP_FIELDS:
        stamps = np.array([row[field] for row in rows], dtype=np.int64) - zero_ns
        return stamps.astype(np.float64) * 1e-9
    values: list[Any] = [row.get(field) for row in rows]
    if any(value is None for value in values):
        return None
    if not _is_list(values[0]):
        return as_floats(values)
    sizes = {len(value) for value in values}
    if len(sizes) != 1 or 0 in sizes or isinstance(values[0][0], str):
        return None
    table = as_floats(values)
    if names and table.shape[1] == len(names):
        for number, row in enumerate(rows):
            if tuple(row["name"]) != names:
                order = [list(row["name"]).index(name) for name in names]
                table[number] = table[number, order]
    return table
