"""Decodes every message of an episode with mcap's own reader and mcap_ros2."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def main(path: Path) -> None:
    """Decode all, checksums compared, and count."""
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        topics = Counter(channel.topic for _, channel, _, _ in reader.iter_decoded_messages())
    if summary is None or summary.statistics is None:
        raise AssertionError("no summary")
    if sum(topics.values()) != summary.statistics.message_count:
        raise AssertionError(f"{sum(topics.values())} of {summary.statistics.message_count} messages")
    print(f"{sum(topics.values())} messages on {len(topics)} topics")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
