"""Reads MCAP files that may be incomplete, damaged or malicious, record by record.

The readers of the mcap library stop at the first error. This one continues with the next chunk, and reports
the byte ranges that it could not use. For any bytes, its time is linear in the size of the file, and so is
the size of all unpacked chunks together (:data:`MAX_RATIO`).
"""

from __future__ import annotations

import dataclasses
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

from deal_hw.data.files import EpisodeFile

MAX_CHUNK_BYTES = 16 << 20
"""Largest record, and largest unpacked chunk [B]. The recorder closes a chunk at 1 MiB."""
MAX_RATIO = 256
"""Largest size of all unpacked chunks, as a multiple of the file's size. A Go2 at rest, which sends the same
bytes all the time, reaches 46."""
_FREE_BYTES = 2 << 20
"""Unpacked size that is allowed at any ratio: more than the recorder's longest chunk [B]."""
_TRIES = 4
"""Bytes of unusable records that are read, per byte of the file. A damaged chunk is read twice: at its place,
and in the search for the next one. Only a file with records that overlap needs more."""

_PREFIX = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII4sQ")
"""Head of a zstd chunk, after its prefix: first and last stamp, size, CRC, the compression's name, length."""
_HEAD_BYTES = _CHUNK_HEAD.size + 18
"""The same, and the longest head of a zstd frame [B]."""
_CHUNK_MARK = struct.pack("<I", 4) + b"zstd"
_CHUNK_MARK_OFFSET = _PREFIX.size + 8 + 8 + 8 + 4
"""From a chunk record's first byte to its compression name: prefix, start, end, uncompressed size, CRC."""
# A flipped bit in the head of a compressed frame can announce any size; this raises the last two.
_PARSE_ERRORS = (
    McapError,
    CRCValidationError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    MemoryError,
    OverflowError,
)
_SUMMARY_ONLY = {
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}
_ZEROS = "zeros where a record should be"

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
class FoundRecord:
    """One readable record; a chunk comes with its contents.

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
        reason: Why the first of them could not be used.
        torn: True for the incomplete end of a file, False for damage.
    """

    offset: int
    size: int
    reason: str
    torn: bool


def scan(data: bytes | EpisodeFile) -> Iterator[FoundRecord | Lost]:
    """Yield the records of a file in order, and one :class:`Lost` for each unreadable place between them.

    Ends after the footer. A file without one ends with a torn :class:`Lost`, of size 0 if it was cut between
    records. Records of other kinds (message indexes, summary) are skipped, because a writer makes them again.
    """
    lost: Lost | None = None
    for item in _Scanner(data).items():
        if isinstance(item, FoundRecord):
            if lost is not None:
                yield lost
            lost = None
            yield item
        elif lost is None or item.torn or lost.offset + lost.size != item.offset:
            if lost is not None:
                yield lost
            lost = item
        else:
            lost = dataclasses.replace(lost, size=lost.size + item.size)
    if lost is not None:
        yield lost


class _Scanner:
    """Reads a file once, and remembers where the next readable chunk is."""

    def __init__(self, data: bytes | EpisodeFile) -> None:
        self._data = data
        self._left = _TRIES * len(data) + MAX_CHUNK_BYTES
        self._room = MAX_RATIO * len(data) + _FREE_BYTES
        self._chunk: FoundRecord | None = None
        self._searched = 0

    def items(self) -> Iterator[FoundRecord | Lost]:
        """Yield found records and lost bytes; lost bytes may come in several pieces."""
        data, offset, in_data_section = self._data, len(MCAP0_MAGIC), True
        while True:
            if offset + _PREFIX.size > len(data):
                yield Lost(offset, len(data) - offset, "the file ends without a footer", torn=True)
                return
            opcode, size = self._prefix(offset)
            end = offset + _PREFIX.size + size
            # Zeros are no record: their length field has no meaning, and there may be millions of them.
            result = self._parse(opcode, offset, end) if opcode and end <= len(data) else None
            if not in_data_section and result is None:
                yield Lost(offset, len(data) - offset, "the index is cut off", torn=True)
                return
            if opcode in _SUMMARY_ONLY and in_data_section:
                result = "a record out of place"
            if isinstance(result, str) or result is None:
                reason = result or ("a record that is cut off" if opcode else _ZEROS)
                lost = self._skip(offset, None if result is None else end, reason)
                yield lost
                if lost.torn:
                    return
                offset += lost.size
                continue
            if isinstance(result, FoundRecord):
                yield result
                in_data_section = in_data_section and not isinstance(result.record, DataEnd)
                if isinstance(result.record, Footer):
                    if data[end : end + 2 * len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                        left = len(data) - end
                        yield Lost(end, left, "bytes behind the footer", torn=left < len(MCAP0_MAGIC))
                    return
            offset = end

    def _skip(self, offset: int, end: int | None, reason: str) -> Lost:
        """Return the bytes to skip from an unusable record on; ``end``: the record's end, None if unknown.

        The record's length may be wrong. So reading continues at the next readable chunk if that comes
        earlier.
        """
        chunk = self._next_chunk(offset + 1)
        if self._left <= 0:
            # No recorder writes such a file, and reading on would take quadratic time.
            return Lost(offset, len(self._data) - offset, "broken records that overlap", torn=True)
        stops = [stop for stop in (chunk, end) if stop is not None]
        stop = min(stops, default=len(self._data))
        return Lost(offset, stop - offset, reason, torn=not stops)

    def _prefix(self, offset: int) -> tuple[int, int]:
        """Return opcode and length of the record there."""
        opcode, size = _PREFIX.unpack(self._data[offset : offset + _PREFIX.size])
        return opcode, size

    def _parse(self, opcode: int, offset: int, end: int) -> FoundRecord | str | bool:
        """Return the record, or why it is unusable, or True for a kind that is skipped."""
        if self._chunk is not None and self._chunk.offset == offset:
            return self._chunk
        kind, start = _TYPES.get(opcode), offset + _PREFIX.size
        size = end - start
        # Places that only look like records may be many and long, so a record is read after its head.
        head = self._data[start : min(end, start + _HEAD_BYTES)]
        if kind is None:
            index = opcode == Opcode.MESSAGE_INDEX
            sound = _is_message_index(head, size) if index else opcode in _SUMMARY_ONLY
            return sound or "a record of an unknown kind"
        if kind is Chunk and (wrong := self._refuse_chunk(head, size)):
            return wrong
        if size > MAX_CHUNK_BYTES:
            return f"a {kind.__name__.lower()} of {size} bytes (at most {MAX_CHUNK_BYTES} are read)"
        body = memoryview(self._data[start:end])
        result = _read_chunk(body, offset) if kind is Chunk else _read_record(kind, body, offset)
        if isinstance(result, str):
            self._left -= size
        return result

    def _refuse_chunk(self, head: bytes, length: int) -> str:
        """Return why a chunk cannot be unpacked, without unpacking it; "" if it can."""
        if length < _CHUNK_HEAD.size:
            return "a chunk of a wrong length"
        _, _, size, _, name_size, name, packed_size = _CHUNK_HEAD.unpack_from(head)
        # A wrong, larger length would include the chunks after it.
        if (name_size, name) != (4, b"zstd") or length != _CHUNK_HEAD.size + packed_size:
            return "a chunk of a wrong length"
        if size > min(MAX_CHUNK_BYTES, self._room):
            return f"a chunk that announces {size} bytes in {packed_size}"
        try:
            # The decompressor allocates the size in the frame's head, not the size in the chunk's head.
            announced = zstandard.get_frame_parameters(head[_CHUNK_HEAD.size :]).content_size
        except zstandard.ZstdError as error:
            return _damaged(Chunk, error)
        if announced not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            return "a chunk whose sizes contradict each other"
        self._room -= size
        return ""

    def _next_chunk(self, start: int) -> int | None:
        """Return where the next readable chunk starts, at or after ``start``, which never goes back."""
        if self._chunk is not None and self._chunk.offset >= start:
            return self._chunk.offset
        start = max(start, self._searched)
        self._chunk = None
        mark = self._data.find(_CHUNK_MARK, start + _CHUNK_MARK_OFFSET)
        while mark >= 0 and self._left > 0:
            offset = mark - _CHUNK_MARK_OFFSET
            self._searched = offset + 1
            opcode, size = self._prefix(offset)
            end = offset + _PREFIX.size + size
            if opcode == Opcode.CHUNK and end <= len(self._data):
                found = self._parse(opcode, offset, end)
                if isinstance(found, FoundRecord):
                    self._chunk = found
                    return offset
            mark = self._data.find(_CHUNK_MARK, mark + 1)
        self._searched = len(self._data)
        return None


def _read_record(kind: type[McapRecord], body: memoryview, offset: int) -> FoundRecord | str:
    try:
        record: McapRecord = kind.read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
        builder = RecordBuilder()
        record.write(builder)
        # The library reads past the end of a record without an error; only encoding it again shows that.
        same = builder.end()[_PREFIX.size :] == body
    except _PARSE_ERRORS as error:
        return _damaged(kind, error)
    return FoundRecord(offset, record) if same else _damaged(kind)


def _read_chunk(body: memoryview, offset: int) -> FoundRecord | str:
    start_ns, end_ns, size, crc, *_ = _CHUNK_HEAD.unpack_from(body)
    packed = body[_CHUNK_HEAD.size :]
    try:
        plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        if len(plain) != size:
            return "a chunk whose sizes contradict each other"
        record = Chunk(
            compression="zstd",
            data=bytes(packed),
            message_start_time=start_ns,
            message_end_time=end_ns,
            uncompressed_crc=crc,
            uncompressed_size=size,
        )
        unpacked = dataclasses.replace(record, compression="", data=plain)
        return FoundRecord(offset, record, tuple(breakup_chunk(unpacked, validate_crc=True)))
    except _PARSE_ERRORS as error:
        return _damaged(Chunk, error)


def _damaged(kind: type[McapRecord], error: Exception | None = None) -> str:
    why = f" ({(str(error) or type(error).__name__)[:60]})" if error is not None else ""
    return f"a damaged {kind.__name__.lower()}{why}"


def _is_message_index(head: bytes, length: int) -> bool:
    return length >= 6 and length == 6 + int.from_bytes(head[2:6], "little")


def messages(found: FoundRecord) -> Iterator[Message]:
    """Yield the messages of a chunk."""
    return (record for record in found.contents if isinstance(record, Message))
