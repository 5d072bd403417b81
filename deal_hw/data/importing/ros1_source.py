"""Reads bags of ROS 1 (``rosbag record``) into channels ``/topic.field``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap.records import Schema

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.mcap_source import LEAF_COST, reason_of
from deal_hw.data.importing.topics import Row, channels_of_topics, is_list, named
from deal_hw.errors import MissingExtraError, short
from deal_hw.reading import NUMBERS, RECORDING_BYTES, check_size, reading


def read_ros1_bag(path: Path) -> Channels:
    """Read all numbers of all topics, as :func:`~deal_hw.data.importing.mcap_source.read_mcap` does.

    Raises:
        MissingExtraError: rosbags is not installed.
        DatasetError: It cannot be read.
    """
    path = Path(path)
    try:
        from rosbags.rosbag1 import Reader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtraError("rosbags", "formats") from error
    with reading(path, "a bag of ROS 1", "if it is incomplete, `rosbag reindex` repairs it"):
        check_size(path, RECORDING_BYTES)
        store = get_typestore(Stores.EMPTY)
        topics: dict[str, list[Row]] = {}
        types: dict[str, str] = {}
        left_out: dict[str, str] = {}
        budget = NUMBERS
        with Reader(path) as bag:
            for connection in bag.connections:
                text = str(connection.msgdef.data)
                kind, topic = str(connection.msgtype), str(connection.topic)
                types[topic] = kind
                if reason := reason_of(Schema(id=1, name=kind, encoding="ros1msg", data=text.encode())):
                    left_out[topic] = reason
                    continue
                try:
                    store.register(
                        {n: t for n, t in get_types_from_msg(text, kind).items() if n not in store.types}
                    )
                except Exception as error:
                    left_out[topic] = f"its definition cannot be understood: {short(error, 80)}"
            kept = [connection for connection in bag.connections if connection.topic not in left_out]
            for connection, stamp_ns, data in bag.messages(connections=kept) if kept else ():
                row = dict(_fields(store.deserialize_ros1(data, connection.msgtype)))
                row["log_time"] = int(stamp_ns)
                row["name"] = named(row)
                budget -= sum(LEAF_COST + (len(v) if is_list(v) else 0) for v in row.values())
                if budget < 0:
                    raise ValueError(
                        f"more than {NUMBERS} numbers; keep the joints' topics (`rosbag filter`)"
                    )
                topics.setdefault(connection.topic, []).append(row)
        return channels_of_topics(path, "ros1", digest_of_file(path), topics, types, left_out)


def _fields(message: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of a message by dotted name; a stamp is one leaf, in integer ns."""
    for field in dataclasses.fields(message):
        value, name = getattr(message, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            if hasattr(value, "sec") and hasattr(value, "nanosec"):
                yield name, int(value.sec) * 10**9 + int(value.nanosec)
            else:
                yield from _fields(value, f"{name}.")
        elif isinstance(value, list) and value and dataclasses.is_dataclass(value[0]):
            yield f"{name}.count", len(value)
            if len(value) == 1:
                yield from _fields(value[0], f"{name}.")
        elif isinstance(value, (bool, int, float)) or is_list(value):
            yield name, value
