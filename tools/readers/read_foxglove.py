"""Compares our standard messages with what Foxglove's SDK and mcap_ros2 know of them."""

from __future__ import annotations

import sys
from pathlib import Path

from foxglove import messages
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

STANDARD = {"/joint_states", "/joint_commands", "/joint_commands/requested", "/log", "/tf"}


def fields_of_log() -> list[str]:
    """Return the names of the fields of foxglove.Log, as the SDK has them."""
    found = FileDescriptorSet.FromString(messages.Log.get_schema().data)
    (log,) = [m for file in found.file for m in file.message_type if m.name == "Log"]
    return [field.name for field in log.field]


def main(path: Path) -> None:
    """Decode the standard topics and compare field names and times."""
    seen: set[str] = set()
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, raw, message in reader.iter_decoded_messages():
            if channel.topic not in STANDARD or schema is None:
                continue
            seen.add(channel.topic)
            if raw.log_time < 1_500_000_000 * 10**9:
                raise AssertionError(f"{channel.topic} is logged in 1970")
            if channel.topic == "/log":
                names = [name for name in message.__slots__ if not name.startswith("_")]
                if schema.name != "foxglove_msgs/msg/Log" or sorted(names) != sorted(fields_of_log()):
                    raise AssertionError(f"{schema.name} has {names}, foxglove.Log {fields_of_log()}")
            elif channel.topic != "/tf" and len(message.name) != len(message.position):
                raise AssertionError(f"{channel.topic} names {message.name} for {message.position}")
    if seen != STANDARD:
        raise AssertionError(f"only {sorted(seen)}")
    print(f"{len(seen)} topics, foxglove.Log field by field, times of today")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
