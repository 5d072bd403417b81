"""Reads ROS 2 messages from an MCAP file into channels ``/topic.field``."""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import lz4.frame
import numpy as np
import zstandard
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory

from deal_hw.data.importing.channels import Channels, as_floats, digest_of_file
from deal_hw.errors import DatasetError, short
from deal_hw.reading import MIB, NAMES, NUMBERS, RECORDING_BYTES, check_size, reading
from deal_hw.types import FloatArray

BagMessage: TypeAlias = tuple[Schema | None, Channel, Message]
STAMP_FIELDS = ("log_time", "header.stamp")
"""Times of each topic [s]: the recorder's time of receipt, and the sender's time."""
MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file (mcap.dev/spec)."""
CHUNK_BYTES = 64 * MIB
"""Largest record, and largest chunk once it is unpacked; recorders write chunks of 1 to 4 MiB."""
_LEAF_COST = 16
"""Additional memory of a field of a message, in numbers, beside its values."""
LIST_BYTES = MIB
"""Largest message with a list of messages; a trajectory of ten thousand points."""
NAME_FIELDS = ("name", "joint_names", "dof_names")
"""Fields that name the joints of a message."""
_LISTS = {
    "trajectory_msgs/JointTrajectoryPoint": [
        *[("float64", "[]")] * 4,
        ("builtin_interfaces/Duration", ""),
    ],
    "std_msgs/MultiArrayDimension": [("string", ""), ("uint32", ""), ("uint32", "")],
}
"""Message types that may come in lists; each entry takes bytes in the file, which limits the lists."""
_SCHEMA_PART = re.compile(r"^={3,}\s*^MSG:\s+(\S+)\s*$", re.MULTILINE)
_SCHEMA_FIELD = re.compile(r"^[ \t]*(\w+(?:/\w+)*)(?:<=\d+)?(\[[^\]\n]*\])?[ \t]+\w+", re.MULTILINE)


def read_mcap(path: Path) -> Channels:
    """Read all numbers of all topics.

    A message such as ``sensor_msgs/msg/JointState`` on ``/joint_states`` gives ``/joint_states.position``
    (T, K) with the names of its field ``name`` as labels, whatever order single messages have,
    ``/joint_states.log_time`` and ``/joint_states.header.stamp`` (T,) [s], both on one zero. Nested fields
    are joined by dots: ``/imu.orientation.w``.

    A trajectory of one point gives the fields of that point (``/traj.points.positions``), one of several only
    their number (``/traj.points.count``). Topics with other lists of messages are left out with a note. Sizes
    are limited, see :mod:`deal_hw.reading`.

    Raises:
        DatasetError: It cannot be read, or the messages of one topic differ in their joints.
    """
    path = Path(path)
    with reading(path, "MCAP with ROS 2 messages", "if it is incomplete, `mcap recover` repairs it"):
        check_size(path, RECORDING_BYTES)
        with open(path, "rb") as file:
            begin = file.read(len(MAGIC))
        if begin != MAGIC:
            raise ValueError(f"it begins with {begin!r}, MCAP with {MAGIC!r}: it is another kind of file")
        digest = digest_of_file(path)
        try:
            return channels_of(path, digest, messages(path))
        except struct.error as error:
            raise ValueError("it ends, or is damaged, in the middle of a record") from error


def channels_of(
    path: Path, digest: str, bag: Iterable[BagMessage], left_out: Mapping[str, str] | None = None
) -> Channels:
    """Return the channels of the messages of a bag; to be called inside :func:`~deal_hw.reading.reading`.

    Args:
        path: The bag.
        digest: Digest of its bytes.
        bag: Its messages, each with schema and channel.
        left_out: Topics whose messages are not in ``bag``, and why; it may grow as that is read.
    """
    topics: dict[str, list[dict[str, Any]]] = {}
    types: dict[str, str] = {}
    factory = DecoderFactory()
    notes: dict[str, str] = {}
    budget = NUMBERS
    for schema, channel, message in bag:
        if channel.topic not in notes:
            notes[channel.topic] = _reason_to_leave_out(schema)
            types[channel.topic] = "" if schema is None else schema.name
        if notes[channel.topic]:
            continue
        decode = factory.decoder_for(channel.message_encoding, schema)
        if decode is None:
            raise ValueError(
                f"{short(channel.topic)} is not in ROS 2's encoding, but {channel.message_encoding}"
            )
        if len(message.data) > LIST_BYTES and _has_lists(schema):
            raise ValueError(f"a message of more than {LIST_BYTES / MIB:g} MiB on {short(channel.topic)}")
        row = dict(_fields(decode(message.data)))
        row["log_time"] = message.log_time
        row["name"] = next((row[field] for field in NAME_FIELDS if field in row), ())
        budget -= sum(_LEAF_COST + (len(v) if _is_list(v) else 0) for v in row.values())
        if budget < 0:
            raise ValueError(f"more than {NUMBERS} numbers; keep the joints' topics (`mcap filter`)")
        topics.setdefault(channel.topic, []).append(row)
    for rows in topics.values():
        rows.sort(key=lambda row: int(row["log_time"]))
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
    reasons = {**(left_out or {}), **notes}
    said = tuple(f"{short(topic, 60)} is left out: {why}" for topic, why in reasons.items() if why)
    return Channels(
        path=path, kind="mcap", digest=digest, arrays=arrays, labels=labels, types=types, notes=said
    )


def messages(path: Path) -> Iterator[BagMessage]:
    """Yield the messages of a file in its own order, checksums compared."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with open(path, "rb") as file:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=CHUNK_BYTES)
        for top in reader.records:
            parts: Sequence[McapRecord] = [top]
            if isinstance(top, Chunk):
                parts = breakup_chunk(_unpacked(top), validate_crc=True)
            for record in parts:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    yield schemas.get(channel.schema_id), channel, record


def _unpacked(chunk: Chunk) -> Chunk:
    """Return a chunk without compression; a few bytes must not become gigabytes."""
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(CHUNK_BYTES + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=CHUNK_BYTES + 1)
    else:
        return chunk
    if len(data) > CHUNK_BYTES:
        raise ValueError(f"a chunk of more than {CHUNK_BYTES / MIB:g} MiB")
    return dataclasses.replace(chunk, compression="", data=data)


def _reason_to_leave_out(schema: Schema | None) -> str:
    """Return why messages of a schema are not decoded; "" if they are.

    The decoder follows the schema alone. A list of empty messages may have four thousand million entries, and
    messages that contain another one twice double with each level, both without a byte of data.
    """
    if schema is None:
        return ""
    parts = _SCHEMA_PART.split(schema.data.decode("utf-8"))
    fields = {
        name.replace("/msg/", "/"): _SCHEMA_FIELD.findall(text)
        for name, text in zip([schema.name, *parts[1::2]], parts[::2], strict=True)
    }
    open_, count = [schema.name.replace("/msg/", "/")], 0
    while open_:
        package = open_[-1].partition("/")[0]
        for kind, is_list in fields.get(open_.pop(), ()):
            full = kind if "/" in kind else f"{package}/{kind}"
            if full.replace("/msg/", "/") in fields:
                if is_list and fields[full.replace("/msg/", "/")] != _LISTS.get(full.replace("/msg/", "/")):
                    return f"{kind}{is_list} is a list of messages"
                open_.append(full.replace("/msg/", "/"))
            count += 1
            if count > NAMES:
                return f"its messages have more than {NAMES} fields"
    return ""


def _has_lists(schema: Schema | None) -> bool:
    return schema is not None and any(f"MSG: {name}" in schema.data.decode() for name in _LISTS)


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
        elif isinstance(value, list) and hasattr(value[0], "__slots__"):
            yield f"{name}.count", len(value)
            if len(value) == 1:
                yield from _fields(value[0], f"{name}.")


def _is_list(value: Any) -> bool:
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
        return False
    return len(value) == 0 or isinstance(value[0], (int, float, str, np.number))


def _first_stamp(topics: dict[str, list[dict[str, Any]]]) -> int:
    """Return the earliest stamp in the file [ns], the zero of all.

    It is subtracted in integers, since absolute nanoseconds would lose their last digits as floats.
    """
    every = (row for rows in topics.values() for row in rows)
    return min((row[kind] for row in every for kind in STAMP_FIELDS if row.get(kind, 0) > 0), default=0)


def _names(path: Path, topic: str, rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return the joints of a topic in the order of its first message; () if it names none."""
    first: Any = rows[0]["name"]
    if not _is_list(first) or not all(isinstance(name, str) for name in first):
        return ()
    names = tuple(first)
    for number, row in enumerate(rows):
        if set(row["name"]) != set(names):
            raise DatasetError(
                f"{path}: message {number} on {topic} names the joints {sorted(row['name'])}, but the "
                f"first one {sorted(names)}; record each publisher on its own topic"
            )
    return names


def _channel(
    rows: list[dict[str, Any]], field: str, names: tuple[str, ...], zero_ns: int
) -> FloatArray | None:
    """Return one field of all messages, (T,) or (T, K); None if it is not numbers of one length."""
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
