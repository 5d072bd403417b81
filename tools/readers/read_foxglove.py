"""Compares our standard messages with the definitions in Foxglove's SDK and mcap_ros2."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from foxglove import messages
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

STANDARD = {"/joint_states", "/joint_commands", "/joint_commands/requested", "/log", "/tf"}


def known_fields(kind: Any) -> dict[str, set[str]]:
    """Return the fields of a message of the SDK and of those inside it, by type without its package."""
    found = FileDescriptorSet.FromString(kind.get_schema().data)
    return {m.name: {field.name for field in m.field} for file in found.file for m in file.message_type}


def said_fields(schema: Any) -> dict[str, set[str]]:
    """Return the fields of Foxglove's messages in a schema of the file."""
    first, *rest = schema.data.decode().split("=" * 80 + "\nMSG: ")
    parts = [f"{schema.name}\n{first}", *rest]
    split = (part.split("\n", 1) for part in parts if part.startswith("foxglove_msgs"))
    return {
        name.rpartition("/")[2]: {line.split()[1] for line in text.splitlines() if line}
        for name, text in split
    }


def compare(schema: Any, kind: Any) -> None:
    """Compare a schema in the file with the SDK's, field by field."""
    known = known_fields(kind)
    for name, fields in said_fields(schema).items():
        if fields != known[name]:
            raise AssertionError(f"{name} has {sorted(fields)}, Foxglove's {sorted(known[name])}")


def main(path: Path) -> None:
    """Decode the standard topics and compare field names and times."""
    seen: set[str] = set()
    shapes = 0
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, raw, message in reader.iter_decoded_messages():
            if channel.topic == "/scene":
                shapes += len(message.entities)
                compare(schema, messages.SceneUpdate)
            if channel.topic not in STANDARD:
                continue
            seen.add(channel.topic)
            if raw.log_time < 1_500_000_000 * 10**9:
                raise AssertionError(f"{channel.topic} is logged in 1970")
            if channel.topic == "/log":
                compare(schema, messages.Log)
            elif channel.topic != "/tf" and len(message.name) != len(message.position):
                raise AssertionError(f"{channel.topic} names {message.name} for {message.position}")
    if seen != STANDARD:
        raise AssertionError(f"only {sorted(seen)}")
    print(f"{len(seen)} topics and {shapes} shapes, Foxglove's schemas field by field, times of today")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
