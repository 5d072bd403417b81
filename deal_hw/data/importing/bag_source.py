"""Reads ROS 2 bags as ``ros2 bag record`` leaves them: a folder of MCAP or SQLite files, or one of these."""

from __future__ import annotations

import dataclasses
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final
from urllib.parse import quote

from mcap.records import Channel, Message, Schema

from deal_hw.data.importing.channels import Channels, digest_of_files
from deal_hw.data.importing.mcap_source import KNOWN, MAGIC, BagMessage, channels_of, messages
from deal_hw.errors import DatasetError, short
from deal_hw.reading import NAMES, RECORDING_BYTES, check_size, reading

SQLITE: Final = b"SQLite format 3\0"
_SCHEMAS: Final = 1 << 16
"""Numbers of schemas that one file may have."""
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_CONVERT: Final = "`ros2 bag convert` writes MCAP without compression"


def read_bag(path: Path, files: Sequence[Path] = ()) -> Channels:
    """Read all numbers of all topics, as :func:`~deal_hw.data.importing.mcap_source.read_mcap` does.

    Args:
        path: The bag's file, or its folder.
        files: The folder's files, of one recording in several parts.

    Raises:
        DatasetError: It cannot be read, or is compressed.
    """
    parts = tuple(files) or (path,)
    with reading(path, "a bag of ROS 2", "if it is incomplete, `ros2 bag reindex` repairs it"):
        total = 0
        for part in parts:
            check_size(part, RECORDING_BYTES)
            total += part.stat().st_size
        if total > RECORDING_BYTES:
            raise ValueError("its files are larger together than one may be; import them one by one")
        notes: dict[str, str] = {}

        def every() -> Iterator[BagMessage]:
            for number, part in enumerate(parts):
                with open(part, "rb") as file:
                    begin = file.read(len(SQLITE))
                if begin.startswith(MAGIC):
                    found = messages(part)
                elif begin == SQLITE:
                    found = _rows(part, notes)
                else:
                    raise ValueError(f"{part.name} begins with {begin[:8]!r}: it is no file of a bag")
                for schema, channel, message in found:
                    # The decoder remembers schemas by their numbers, which each file has for itself.
                    own = schema and dataclasses.replace(schema, id=schema.id + number * _SCHEMAS)
                    yield own, channel, message

        return channels_of(path, digest_of_files(parts), every(), notes)


def bag_files(folder: Path) -> list[Path]:
    """Return the files of a bag's folder; none if it is no bag.

    Raises:
        DatasetError: They are compressed.
    """
    if not (folder / "metadata.yaml").is_file():
        return []
    packed = [one.name for one in folder.iterdir() if one.suffix in (".zstd", ".zst")]
    if packed:
        raise DatasetError(f"{folder} is a compressed bag ({short(', '.join(packed), 80)}); {_CONVERT}")
    return sorted([*folder.glob("*.mcap"), *folder.glob("*.db3")])


def _rows(path: Path, notes: dict[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of a SQLite file; ``notes`` gets the topics that are left out."""
    # Not changed, and no journal of another program beside it is read.
    database = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    try:
        # A view in place of a table could compute for ever.
        database.execute("PRAGMA trusted_schema = OFF")
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise ValueError(f"its tables are {short(', '.join(sorted(tables)), 80)}, not those of a bag")
        definitions = dict(KNOWN)
        if "message_definitions" in tables:
            definitions |= {
                str(kind): str(text)
                for kind, encoding, text in database.execute(
                    "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions "
                    "LIMIT ?",
                    (NAMES,),
                )
                if encoding == "ros2msg"
            }
        topics: dict[int, tuple[Schema, Channel]] = {}
        listed = database.execute("SELECT id, name, type, serialization_format FROM topics LIMIT ?", (NAMES,))
        for number, topic, kind, encoding in listed.fetchall():
            if kind not in definitions:
                notes[str(topic)] = f"the bag holds no definition of {short(str(kind), 60)}"
                continue
            key = 1 + list(definitions).index(kind)
            schema = Schema(id=key, name=str(kind), encoding="ros2msg", data=definitions[kind].encode())
            channel = Channel(
                id=number, topic=str(topic), message_encoding=str(encoding), metadata={}, schema_id=key
            )
            topics[number] = schema, channel
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp")
        for sequence, (number, stamp_ns, data) in enumerate(rows):
            if number not in topics:
                continue
            schema, channel = topics[number]
            if not isinstance(data, bytes) or not isinstance(stamp_ns, int):
                raise ValueError(f"message {sequence} on {short(channel.topic)} is no message")
            if data.startswith(_ZSTD):
                raise DatasetError(f"{path}: its messages are compressed; {_CONVERT}")
            message = Message(
                channel_id=number, log_time=stamp_ns, data=data, publish_time=stamp_ns, sequence=sequence
            )
            yield schema, channel, message
    finally:
        database.close()
