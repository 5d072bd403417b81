"""Feetech's protocol for STS and SMS servos, from both sides.

A request is FF FF, id, length, instruction, parameters, checksum; an answer has the error byte in place of
the instruction. The length counts what follows it. The checksum is the inverted sum of the bytes behind the
header. Data have no stuffing bytes, so FF FF may also occur inside a frame, and only the checksum of 8 bits
shows where a frame begins. Numbers are little-endian.

Source: Feetech's communication protocol manual. This codec is our own: Feetech's SDKs compute deadlines with
the wall clock and allow an absent servo 50 ms.
"""

from __future__ import annotations

import abc
import enum
from collections.abc import Iterator
from typing import Final, Generic, NamedTuple, TypeVar

HEADER: Final = b"\xff\xff"
BROADCAST: Final = 0xFE
MAX_ID: Final = 253
FRAME_BYTES: Final = 6
"""Bytes of a frame without parameters or data: header 2, id, length, instruction or error, checksum."""
MAX_FRAME_BYTES: Final = 250
"""Largest frame of Feetech's SDK."""
_LEAST_LENGTH = 2
_MOST_LENGTH = 255


class StsInstruction(enum.IntEnum):
    """Instruction of a request."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    """Factory values in all of the EEPROM except the id."""
    REBOOT = 0x08
    """Not answered; the servo is silent for 0.8 s."""
    BACKUP = 0x09
    """Keeps the EEPROM's values for FACTORY_RESET."""
    RESET = 0x0A
    """Clears the status and the turns."""
    CALIBRATE = 0x0B
    """Makes the present position 2048, or the position in two bytes; STS with firmware 3.10 or newer."""
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


Instruction = StsInstruction


class Fault(enum.IntFlag):
    """Bits of an answer's error byte and of the register Status."""

    VOLTAGE = 0x01
    ENCODER = 0x02
    TEMPERATURE = 0x04
    CURRENT = 0x08
    OVERLOAD = 0x20


FAULTS: Final = {
    Fault.VOLTAGE: (
        "input voltage out of its limits",
        "check the supply under load and which servo it is: 7.4 V or 12 V; limits: registers 14 and 15",
    ),
    Fault.ENCODER: (
        "position sensor fault",
        "switch it off and on; if the fault returns, the servo is broken",
    ),
    Fault.TEMPERATURE: ("overheated", "let it cool, then look for friction, a jam or too high a load"),
    Fault.CURRENT: ("current too high", "look for a jam or a short; lower the torque limit"),
    Fault.OVERLOAD: (
        "overload: it holds with reduced torque",
        "take the load off and look for a jam; if the next start still reports it, switch the servo's supply "
        "off and on",
    ),
}
"""Meaning and remedy of each fault."""


def explain_fault(value: int) -> str:
    """Return the bits of an error byte in words, with the remedy of each."""
    known = [f"{what} ({remedy})" for bit, (what, remedy) in FAULTS.items() if value & bit]
    unknown = value & ~sum(FAULTS)
    return "; ".join([*known, *([f"unknown bits 0x{unknown:02x}"] if unknown else [])])


class RequestFrame(NamedTuple):
    """A request: servo id or :data:`BROADCAST`, instruction, parameters."""

    servo: int
    instruction: int
    params: bytes

    @property
    def size(self) -> int:
        """Its bytes on the wire."""
        return FRAME_BYTES + len(self.params)


class AnswerFrame(NamedTuple):
    """An answer: servo id, error byte (:class:`Fault`), data."""

    servo: int
    error: int
    data: bytes

    @property
    def size(self) -> int:
        """Its bytes on the wire."""
        return FRAME_BYTES + len(self.data)


def _frame(servo: int, code: int, data: bytes) -> bytes:
    length = len(data) + 2
    if length > _MOST_LENGTH:
        raise ValueError(f"{len(data)} bytes do not fit in a frame: allowed are {_MOST_LENGTH - 2}")
    body = bytes([servo, length, code]) + data
    return HEADER + body + bytes([checksum(body)])


def checksum(body: bytes) -> int:
    """Return the checksum of the bytes between a frame's header and its checksum."""
    return ~sum(body) & 0xFF


def encode(servo: int, instruction: int, params: bytes = b"") -> bytes:
    """Return a request.

    Args:
        servo: Id of the servo, or :data:`BROADCAST`.
        instruction: One of :class:`StsInstruction`.
        params: Its parameters.

    Raises:
        ValueError: More parameters than a frame has room for.
    """
    return _frame(servo, instruction, params)


def status(servo: int, error: int, data: bytes = b"") -> bytes:
    """Return an answer.

    Raises:
        ValueError: More data than a frame has room for.
    """
    return _frame(servo, error, data)


FrameT = TypeVar("FrameT", RequestFrame, AnswerFrame)


class _FrameParser(abc.ABC, Generic[FrameT]):
    """Finds frames in a stream of bytes; no bytes make it fail.

    Behind a corrupt frame it looks for the next header inside that frame. So a lost or an additional byte
    costs one frame only.

    Attributes:
        errors: Frames whose checksum or length was wrong, or that were given up as incomplete.
        skipped: Bytes that belong to no sound frame.
        longest: Largest frame to accept [bytes]. A corrupt length makes the parser wait for so many bytes.
    """

    def __init__(self, longest: int = _MOST_LENGTH + 4) -> None:
        self.errors = self.skipped = 0
        self.longest = longest
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[FrameT]:
        """Take bytes; yield the sound frames that they complete."""
        self._buffer += data
        while (size := self._find()) > 0:
            whole = bytes(self._buffer[:size])
            del self._buffer[:size]
            yield self._content(whole[2], whole[4], whole[5:-1])

    def finish(self) -> Iterator[FrameT]:
        """Expect no more bytes: give incomplete frames up, and yield the sound ones that begin in them."""
        yield from self.feed(b"")
        while self._buffer:
            if self._buffer.startswith(HEADER):
                self._break()
            else:
                self._skip(len(self._buffer))
            yield from self.feed(b"")

    def reset(self) -> None:
        """Forget the bytes of an incomplete frame, without counting them."""
        self._buffer.clear()

    @property
    def waits(self) -> bool:
        """Whether it holds the beginning of a frame."""
        return bool(self._buffer)

    @staticmethod
    @abc.abstractmethod
    def _content(servo: int, code: int, data: bytes) -> FrameT:
        """Return a frame's content."""

    def _find(self) -> int:
        """Discard everything before the next sound frame; return its size, 0 while none is complete."""
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                # The last byte may be the beginning of a header.
                self._skip(len(buffer) - buffer.endswith(HEADER[:1]))
                return 0
            self._skip(start)
            if len(buffer) > 2 and buffer[2] > BROADCAST:
                # No id: with FF FF FF the header begins one byte later.
                self._skip(1)
                continue
            if len(buffer) < 4:
                return 0
            size = 4 + buffer[3]
            if buffer[3] < _LEAST_LENGTH or size > self.longest:
                self._break()
            elif len(buffer) < size:
                return 0
            elif checksum(bytes(buffer[2 : size - 1])) != buffer[size - 1]:
                self._break()
            else:
                return size

    def _break(self) -> None:
        """Skip only the header of a corrupt frame, because a sound frame may begin inside it."""
        self.errors += 1
        self._skip(len(HEADER))

    def _skip(self, count: int) -> None:
        self.skipped += count
        del self._buffer[:count]


class RequestParser(_FrameParser[RequestFrame]):
    """Finds requests in a stream of bytes, as a servo does."""

    @staticmethod
    def _content(servo: int, code: int, data: bytes) -> RequestFrame:
        return RequestFrame(servo, code, data)


class AnswerParser(_FrameParser[AnswerFrame]):
    """Finds answers in a stream of bytes, as a host does.

    An echo of the host's own requests is yielded, too: the frames look alike.
    """

    @staticmethod
    def _content(servo: int, code: int, data: bytes) -> AnswerFrame:
        return AnswerFrame(servo, code, data)
