"""Reads ROS 2 messages from an MCAP file into channels ``/topic.field``."""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import lz4.frame
import zstandard
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.topics import Row, channels_of_topics, is_list, named
from deal_hw.data.recording.schemas import FLOAT64_MULTI_ARRAY, JOINT_STATE, JOINT_TRAJECTORY
from deal_hw.errors import short
from deal_hw.reading import MIB, NAMES, NUMBERS, RECORDING_BYTES, check_size, reading

BagMessage: TypeAlias = tuple[Schema | None, Channel, Message]
MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file (mcap.dev/spec)."""
CHUNK_BYTES = 64 * MIB
"""Largest record, and largest chunk once it is unpacked; recorders write chunks of 1 to 4 MiB."""
LEAF_COST = 16
"""Additional memory of a field of a message, in numbers, beside its values."""
LIST_BYTES = MIB
"""Largest message with a list of messages; a trajectory of ten thousand points."""
KNOWN: Final = {kind.name: kind.definition for kind in (JOINT_STATE, FLOAT64_MULTI_ARRAY, JOINT_TRAJECTORY)}
"""Definitions for bags that hold none, such as those of ROS 2 Humble and older."""
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

    Where the messages of one topic name different joints, as of an arm and its gripper, these are merged by
    name, with a note.

    A trajectory of one point gives the fields of that point (``/traj.points.positions``), one of several only
    their number (``/traj.points.count``). Topics with other lists of messages, in other encodings than ROS
    2's or without a definition are left out with a note. Sizes are limited, see :mod:`deal_hw.reading`.

    Raises:
        DatasetError: It cannot be read.
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
    topics: dict[str, list[Row]] = {}
    known: dict[str, Schema | None] = {}
    types: dict[str, str] = {}
    factory = DecoderFactory()
    notes: dict[str, str] = {}
    budget = NUMBERS
    for schema, channel, message in bag:
        if channel.topic not in notes:
            notes[channel.topic], known[channel.topic] = _readable(channel, schema, factory)
            types[channel.topic] = "" if schema is None else schema.name
        if notes[channel.topic]:
            continue
        definition = known[channel.topic]
        decode = factory.decoder_for(channel.message_encoding, definition)
        if decode is None:
            raise ValueError(f"the messages on {short(channel.topic)} change their encoding")
        if len(message.data) > LIST_BYTES and _has_lists(definition):
            raise ValueError(f"a message of more than {LIST_BYTES / MIB:g} MiB on {short(channel.topic)}")
        row = dict(_fields(decode(message.data)))
        row["log_time"] = message.log_time
        row["name"] = named(row)
        budget -= sum(LEAF_COST + (len(v) if is_list(v) else 0) for v in row.values())
        if budget < 0:
            raise ValueError(f"more than {NUMBERS} numbers; keep the joints' topics (`mcap filter`)")
        topics.setdefault(channel.topic, []).append(row)
    return channels_of_topics(path, "mcap", digest, topics, types, {**(left_out or {}), **notes})


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


def _readable(channel: Channel, schema: Schema | None, factory: DecoderFactory) -> tuple[str, Schema | None]:
    """Return why messages of a topic are not decoded, "" if they are, and what to decode them by."""
    if channel.message_encoding != MessageEncoding.CDR:
        return f"its messages are {short(channel.message_encoding, 40)}, not in ROS 2's CDR", None
    if schema is not None and not schema.data and schema.name in KNOWN:
        schema = dataclasses.replace(schema, data=KNOWN[schema.name].encode(), encoding=SchemaEncoding.ROS2)
    if schema is None or not schema.data:
        kind = "its messages" if schema is None else short(schema.name, 60)
        return f"the bag holds no definition of {kind}", None
    if schema.encoding != SchemaEncoding.ROS2:
        return f"its definition is {short(schema.encoding, 40)}, not {SchemaEncoding.ROS2}", None
    if reason := reason_of(schema):
        return reason, None
    try:
        factory.decoder_for(channel.message_encoding, schema)
    except Exception as error:
        return f"its definition cannot be understood: {short(error, 80)}", None
    return "", schema


def reason_of(schema: Schema) -> str:
    """Return why messages of a schema may take more time or memory than they have bytes; "" if they do not.

    The decoder follows the schema alone. A list of empty messages may have four thousand million entries, and
    messages that contain another one twice double with each level, both without a byte of data.
    """
    parts = _SCHEMA_PART.split(schema.data.decode("utf-8"))
    fields = {
        name.replace("/msg/", "/"): _SCHEMA_FIELD.findall(text)
        for name, text in zip([schema.name, *parts[1::2]], parts[::2], strict=True)
    }
    open_, count = [schema.name.replace("/msg/", "/")], 0
    while open_:
        package = open_[-1].partition("/")[0]
        for kind, brackets in fields.get(open_.pop(), ()):
            full = kind if "/" in kind else f"{package}/{kind}"
            if full.replace("/msg/", "/") in fields:
                if brackets and fields[full.replace("/msg/", "/")] != _LISTS.get(full.replace("/msg/", "/")):
                    return f"{kind}{brackets} is a list of messages"
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
        elif isinstance(value, (bool, int, float)) or is_list(value):
            yield name, value
        elif isinstance(value, list) and hasattr(value[0], "__slots__"):
            yield f"{name}.count", len(value)
            if len(value) == 1:
                yield from _fields(value[0], f"{name}.")
