"""Repairs an episode that was cut off by a kill or damaged on disk, and checks complete ones.

Both need time in proportion to the file's size, and memory for one of its chunks.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

from mcap.records import Channel, DataEnd, Footer, Header, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from deal_hw.data.files import EpisodeFile, opened_episode
from deal_hw.data.recording.mcap_scan import FoundRecord, Lost, messages, scan
from deal_hw.data.recording.recorder import LIBRARY
from deal_hw.data.recording.schemas import CHANNELS, FIRST_CHANNELS, METADATA_NAME
from deal_hw.errors import DatasetError

REPAIR_NAME = "deal-hw.repair"
_SHOWN = 3
"""Number of damaged places that a message names; it counts the others."""
_PART_BYTES = 1 << 20
_KEPT = 100
"""Number of damaged places and holes that a report lists; it counts the others."""


@dataclass(frozen=True, slots=True)
class RepairReport:
    """Result of a check or repair of a file.

    Attributes:
        path: The file.
        repaired: Whether it was rewritten.
        torn: Whether it had no footer.
        messages: Readable messages.
        chunks: Readable chunks.
        damaged: Damaged places, as texts; at most the first 100.
        places: Number of all damaged places.
        lost_bytes: Bytes that could not be used.
        lost_spans_s: Begin and end of each hole, where messages are missing: host time since the first
            message [s]; at most the first 100.
        holes: Number of all holes.
        missing_s: Total length of the holes [s].
        original: Path of the kept original; None if it was not kept.
    """

    path: Path
    repaired: bool
    torn: bool
    messages: int
    chunks: int
    damaged: tuple[str, ...] = ()
    places: int = 0
    lost_bytes: int = 0
    lost_spans_s: tuple[tuple[float, float], ...] = ()
    holes: int = 0
    missing_s: float = 0.0
    original: Path | None = None

    @property
    def sound(self) -> bool:
        """Whether the file has no error."""
        return not self.torn and not self.damaged

    def describe(self) -> str:
        """Return one line for the operator, also if many places are damaged."""
        if self.sound:
            return f"{self.path}: sound, {self.messages} messages in {self.chunks} chunks"
        wrong = [*self.damaged[:_SHOWN]]
        if self.torn:
            wrong.insert(0, "no footer (the recorder was killed, the power failed or the disk was full)")
        if self.places > _SHOWN:
            wrong.append(f"{self.places - _SHOWN} more damaged places")
        text = (
            f"{self.path}: {'; '.join(wrong)}. {self.messages} messages in {self.chunks} chunks are readable"
        )
        if self.lost_bytes:
            text += f", {self.lost_bytes} bytes are lost"
        if self.holes:
            what = "a hole" if self.holes == 1 else f"{self.holes} holes, together"
            begins = "it begins" if self.holes == 1 else "the first begins"
            text += f", {what} of {self.missing_s:.3f} s, {begins} {self.lost_spans_s[0][0]:.3f} s into the "
            text += "recording"
        if self.repaired:
            text += ". Rewritten"
            text += f"; the damaged original is {self.original}" if self.original else ""
        return text


def verify(path: Path) -> RepairReport:
    """Check a file, checksums included, without changing it.

    Raises:
        EmptyRecordingError: It has 0 bytes.
        DatasetError: It cannot be read, is too large, or is not an MCAP file of deal-hw.
    """
    with opened_episode(path) as data:
        return _inspect(Path(path), data).report


def repair(path: Path) -> RepairReport:
    """Rewrite an incomplete or damaged file from its readable parts; a valid file is not changed.

    The original stays as ``.torn`` until the new file is complete and in place. After damage other than a
    missing end it is kept, because another tool may be able to read more of it.

    Raises:
        EmptyRecordingError: It has 0 bytes.
        DatasetError: It cannot be read or written, is not an MCAP file of deal-hw, or has nothing readable.
    """
    with opened_episode(path) as data:
        return _repaired(Path(path), data)


def _repaired(path: Path, data: EpisodeFile) -> RepairReport:
    found = _inspect(path, data)
    report = found.report
    if report.sound:
        return report
    kept, fresh = _unused(path.with_name(path.name + ".torn")), path.with_name(path.name + ".repairing")
    try:
        with open(fresh, "wb") as file:
            _rewrite(data, found, file)
            file.flush()
            os.fsync(file.fileno())
        if not verify(fresh).sound:
            raise DatasetError(f"{path}: the repaired copy has errors, too; the original is unchanged")
        os.link(path, kept)
        os.replace(fresh, path)
        if not report.damaged:
            kept.unlink()
    except (OSError, struct.error) as error:
        why = error.strerror if isinstance(error, OSError) else f"MCAP cannot hold its numbers ({error})"
        raise DatasetError(f"{path} cannot be repaired: {why}; the original is unchanged") from error
    finally:
        fresh.unlink(missing_ok=True)
    return replace(report, repaired=True, original=kept if report.damaged else None)


def _unused(path: Path) -> Path:
    number = 0
    candidate = path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}.{number}")
    return candidate


@dataclass(frozen=True, slots=True)
class _Findings:
    report: RepairReport
    header: Header
    schemas: dict[int, Schema]
    channels: dict[int, Channel]


def _inspect(path: Path, data: EpisodeFile) -> _Findings:
    schemas, known = _known()
    # Recorders of version 1 gave later numbers to other channels.
    channels = {number: channel for number, channel in known.items() if number <= FIRST_CHANNELS}
    later = {number: channel for number, channel in known.items() if number > FIRST_CHANNELS}
    header = Header(profile="ros2", library=LIBRARY)
    losses: list[Lost] = []
    spans: list[tuple[float, float]] = []
    first_ns = last_ns = None
    counts: Counter[int] = Counter()
    chunks = 0
    hole = False
    mismatches: list[str] = []
    version = ""
    for item in scan(data):
        if isinstance(item, Lost):
            losses.append(item)
            hole = True
            continue
        if isinstance(item.record, Header):
            header = item.record
        elif isinstance(item.record, DataEnd):
            if item.record.data_section_crc not in (0, _crc(data, 0, item.offset)):
                mismatches.append("the checksum over the whole recording does not match")
        elif isinstance(item.record, Footer) and _is_index_damaged(data, item.offset, item.record):
            mismatches.append("the checksum of the index does not match")
        # Chunks have checksums of their own; the index is used only for names that no chunk contains.
        if isinstance(item.record, Metadata) and item.record.name == METADATA_NAME:
            version = item.record.metadata.get("format_version", "")
        if isinstance(item.record, Schema):
            schemas.setdefault(item.record.id, item.record)
        elif isinstance(item.record, Channel):
            channels.setdefault(item.record.id, item.record)
        schemas.update({record.id: record for record in item.contents if isinstance(record, Schema)})
        channels.update({record.id: record for record in item.contents if isinstance(record, Channel)})
        stamps = [message.log_time for message in messages(item)]
        if stamps:
            chunks += 1
            counts.update(message.channel_id for message in messages(item))
            first_ns = min(stamps) if first_ns is None else first_ns
            if hole and last_ns is not None:
                spans.append(((last_ns - first_ns) * 1e-9, (min(stamps) - first_ns) * 1e-9))
            last_ns, hole = max(stamps), False
    if version != "1":
        for number, channel in later.items():
            channels.setdefault(number, channel)
    if not header.library.startswith("deal-hw"):
        raise DatasetError(
            f"{path} was written by {header.library!r}; only recordings of deal-hw can be repaired"
        )
    damaged = [f"{loss.reason} at byte {loss.offset}" for loss in losses if not loss.torn] or mismatches
    if nameless := sum(count for channel, count in counts.items() if channel not in channels):
        damaged.append(f"{nameless} messages are on channels that the file does not name")
    report = RepairReport(
        path=path,
        repaired=False,
        torn=any(loss.torn for loss in losses),
        messages=counts.total() - nameless,
        chunks=chunks,
        damaged=tuple(damaged[:_KEPT]),
        places=len(damaged),
        lost_bytes=sum(loss.size for loss in losses),
        lost_spans_s=tuple(spans[:_KEPT]),
        holes=len(spans),
        missing_s=sum(stop - start for start, stop in spans),
    )
    return _Findings(report, header, schemas, channels)


def _is_index_damaged(data: EpisodeFile, offset: int, footer: Footer) -> bool:
    # The checksum covers the summary and the footer up to the checksum itself: prefix and two offsets.
    return footer.summary_crc not in (0, _crc(data, footer.summary_start or offset, offset + 9 + 16))


def _crc(data: EpisodeFile, start: int, stop: int) -> int:
    """Return the checksum of a part of a file, which may be long."""
    value = 0
    for at in range(start, stop, _PART_BYTES):
        value = zlib.crc32(data[at : min(at + _PART_BYTES, stop)], value)
    return value


def _known() -> tuple[dict[int, Schema], dict[int, Channel]]:
    """Return schemas and channels with a recorder's numbers, for a file whose first chunk is damaged."""
    schemas: dict[str, Schema] = {}
    channels: dict[int, Channel] = {}
    for number, (topic, kind) in enumerate(CHANNELS.items(), start=1):
        if kind.name not in schemas:
            definition = kind.definition.encode()
            schemas[kind.name] = Schema(
                id=len(schemas) + 1, data=definition, encoding="ros2msg", name=kind.name
            )
        channels[number] = Channel(
            id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=schemas[kind.name].id
        )
    return {schema.id: schema for schema in schemas.values()}, channels


def _rewrite(data: EpisodeFile, findings: _Findings, file: IO[bytes]) -> None:
    """Write the readable parts, chunk by chunk, and a note on the lost ones."""
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile=findings.header.profile, library=LIBRARY)
    schemas = {
        number: writer.register_schema(schema.name, schema.encoding, schema.data)
        for number, schema in sorted(findings.schemas.items())
    }
    channels = {
        number: writer.register_channel(
            channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0), channel.metadata
        )
        for number, channel in sorted(findings.channels.items())
    }
    for item in scan(data):
        if not isinstance(item, FoundRecord):
            continue
        if isinstance(item.record, Metadata):
            writer.add_metadata(item.record.name, item.record.metadata)
        for message in messages(item):
            _copy(writer, message, channels)
        if item.contents:
            writer.flush()
    lost = {"lost_bytes": str(findings.report.lost_bytes), "report": findings.report.describe()}
    writer.add_metadata(REPAIR_NAME, lost)
    writer.finish()


def _copy(writer: Writer, message: Message, channels: dict[int, int]) -> None:
    if message.channel_id in channels:
        writer.add_message(
            channels[message.channel_id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
