"""Reads MCAP files that may be torn or damaged, record by record, without trusting any of them.

The readers of the mcap library stop at the first thing that is wrong; this one goes on with the next chunk,
and says which byte ranges it could not use.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC

_PREFIX = struct.Struct("<BQ")
_CHUNK_MARK = struct.pack("<I", 4) + b"zstd"
_CHUNK_MARK_OFFSET = _PREFIX.size + 8 + 8 + 8 + 4
"""From a chunk record's first byte to its compression name: prefix, start, end, uncompressed size, CRC."""
# A flipped bit in a compressed frame's head can announce any size, hence the last two.
_PARSE_ERRORS = (
    McapError, CRCValidationError, zstandard.ZstdError, struct.error, ValueError, MemoryError, OverflowError,
)  # fmt: skip
_SUMMARY_ONLY = {
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}
_CHUNK_FIELDS = 8 + 8 + 8 + 4 + 4 + 8
"""Bytes of a chunk beside its compression's name and its records."""

_TYPES: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.CHUNK: Chunk,
    Opcode.DATA_END: DataEnd,
    Opcode.FOOTER: Footer,
}


@dataclass(frozen=True, slots=True)
class Found:
    """One readable record; a chunk comes with what is in it.

    Attributes:
        offset: Where it starts in the file.
        record: The record.
        contents: Schemas, channels and messages of a chunk.
    """

    offset: int
    record: McapRecord
    contents: tuple[McapRecord, ...] = ()


@dataclass(frozen=True, slots=True)
class Lost:
    """Bytes that could not be used.

    Attributes:
        offset: Where they start.
        size: How many.
        reason: Why.
        torn: They are the unfinished end of a file, not damage.
    """

    offset: int
    size: int
    reason: str
    torn: bool


def scan(data: bytes) -> Iterator[Found | Lost]:
    """Yield the records of a file in order, and what lies between them unreadable.

    Ends after the footer; a file without one ends with a :class:`Lost` (of size 0 if it was cut between
    records). Records of other kinds (message indexes, summary) are passed over: a writer makes them anew.
    """
    offset = len(MCAP0_MAGIC)
    in_data_section = True
    while True:
        if offset + _PREFIX.size > len(data):
            yield Lost(offset, len(data) - offset, "the file ends without a footer", torn=True)
            return
        opcode, size = _PREFIX.unpack_from(data, offset)
        end = offset + _PREFIX.size + size
        result = _parse(opcode, data[offset + _PREFIX.size : end], offset) if end <= len(data) else None
        if not in_data_section and result is None:
            yield Lost(offset, len(data) - offset, "the index is cut off", torn=True)
            return
        if opcode in _SUMMARY_ONLY and in_data_section:
            result = "a record out of place"
        if isinstance(result, str) or result is None:
            lost = _skip(data, offset, None if result is None else end, result)
            yield lost
            if lost.torn:
                return
            offset += lost.size
            continue
        if isinstance(result, Found):
            yield result
            in_data_section = in_data_section and not isinstance(result.record, DataEnd)
            if isinstance(result.record, Footer):
                if data[end:] != MCAP0_MAGIC:
                    yield Lost(end, len(data) - end, "the file does not end after its footer", torn=True)
                return
        offset = end


def _skip(data: bytes, offset: int, end: int | None, reason: str | None) -> Lost:
    """Return what to pass over from an unusable record on; its end is None where that lies outside the file.

    The length may be what is wrong: the next readable chunk decides where to go on if it comes earlier.
    """
    chunk = _next_chunk(data, offset + 1)
    stops = [stop for stop in (chunk, end) if stop is not None]
    stop = min(stops, default=len(data))
    return Lost(offset, stop - offset, reason or "a record that is cut off", torn=not stops)


def _parse(opcode: int, body: bytes, offset: int) -> Found | str | bool:
    """Return the record, why it is unusable, or True for a kind that is passed over."""
    kind = _TYPES.get(opcode)
    if kind is None:
        sound = _is_message_index(body) if opcode == Opcode.MESSAGE_INDEX else opcode in _SUMMARY_ONLY
        return sound or "a record that makes no sense"
    try:
        record: McapRecord = kind.read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
        if isinstance(record, Chunk):
            # A length that grew would swallow the chunks behind it, and the library reads only what it needs.
            if len(body) != _CHUNK_FIELDS + len(record.compression.encode()) + len(record.data):
                return "a chunk of a wrong length"
            return Found(offset, record, tuple(breakup_chunk(record, validate_crc=True)))
        builder = RecordBuilder()
        record.write(builder)
        # The library reads past the end of a record without complaint; only the way back shows it.
        same = builder.end()[_PREFIX.size :] == body  # type: ignore[no-untyped-call]
    except _PARSE_ERRORS as error:
        return f"a damaged {kind.__name__.lower()} ({str(error) or type(error).__name__})"
    return Found(offset, record) if same else f"a damaged {kind.__name__.lower()}"


def _is_message_index(body: bytes) -> bool:
    return len(body) >= 6 and len(body) == 6 + int.from_bytes(body[2:6], "little")


def _next_chunk(data: bytes, start: int) -> int | None:
    """Return where the next readable chunk starts, at or after ``start``."""
    mark = data.find(_CHUNK_MARK, start + _CHUNK_MARK_OFFSET)
    while mark >= 0:
        offset = mark - _CHUNK_MARK_OFFSET
        opcode, size = _PREFIX.unpack_from(data, offset)
        end = offset + _PREFIX.size + size
        if opcode == Opcode.CHUNK and end <= len(data):
            if isinstance(_parse(opcode, data[offset + _PREFIX.size : end], offset), Found):
                return offset
        mark = data.find(_CHUNK_MARK, mark + 1)
    return None


def messages(found: Found) -> Iterator[Message]:
    """Yield the messages of a chunk."""
    return (record for record in found.contents if isinstance(record, Message))
