"""Protocol 2.0 from the servos' side: decodes instruction packets and encodes status packets.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". The driver uses ROBOTIS' SDK instead, so that the two
sides check each other.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Final, NamedTuple

from fastcrc import crc16

from deal_hw.drivers.servo_bus.registers import Register
from deal_hw.drivers.servo_bus.servos_side import at_once

HEADER: Final = b"\xff\xff\xfd\x00"
BROADCAST: Final = 0xFE
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_STATUS: Final = 0x55
_MOST_LENGTH = 1024
_LEAST_LENGTH = 3


class Instruction(enum.IntEnum):
    """Instruction of a packet."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(enum.IntEnum):
    """Reason why a servo refused an instruction."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT: Final = 0x80
"""Set in every status packet while Hardware Error Status is not 0."""


class Packet(NamedTuple):
    """An instruction packet: servo id, instruction, parameters, and its size on the wire [bytes]."""

    servo: int
    instruction: int
    params: bytes
    size: int


def crc(data: bytes) -> int:
    """Return the CRC of a packet's bytes before it: polynomial 0x8005, nothing reflected, from 0."""
    return int(crc16.umts(data))


def packet(servo: int, body: bytes) -> bytes:
    """Return a packet of a body that begins with its instruction; the CRC is added."""
    body = body.replace(_PLAIN, _STUFFED)
    head = HEADER + bytes([servo]) + (len(body) + 2).to_bytes(2, "little") + body
    return head + crc(head).to_bytes(2, "little")


def instruction(servo: int, code: int, params: bytes = b"") -> bytes:
    """Return an instruction packet."""
    return packet(servo, bytes([code]) + params)


def sync_write(register: Register, values: Mapping[int, int]) -> bytes:
    """Return the instruction packet that writes a register of several servos, by their ids."""
    params = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
    for servo, value in values.items():
        params += bytes([servo]) + value.to_bytes(register.size, "little", signed=value < 0)
    return instruction(BROADCAST, Instruction.SYNC_WRITE, params)


def status(servo: int, error: int, data: bytes = b"") -> bytes:
    """Return a status packet."""
    return packet(servo, bytes([_STATUS, error]) + data)


def fast_status(parts: Sequence[tuple[int, int, bytes]], expected: int) -> bytes:
    """Return the one packet in which several servos answer a Fast Sync or Bulk Read.

    Each servo appends its error, id, data and the CRC of all bytes before. The packet has no stuffing bytes.
    If a requested servo is absent, the packet ends before its part and is shorter than its length field says.

    Args:
        parts: Id, error and data of each servo that answers, in order. Those with one id answer at once.
        expected: Bytes of all requested parts: data, and four more bytes for each servo.
    """
    out = HEADER + bytes([BROADCAST]) + (1 + expected).to_bytes(2, "little") + bytes([_STATUS])
    for servo, answers in groupby(parts, key=itemgetter(0)):
        bodies = [bytes([error, servo]) + data for _, error, data in answers]
        out += at_once(body + crc(out + body).to_bytes(2, "little") for body in bodies)
    return out


class PacketParser:
    """Finds instruction packets in a stream of bytes.

    Attributes:
        errors: Packets whose CRC or length was wrong.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes; yield the valid packets that they complete."""
        self._buffer += data
        while (found := self._next()) is not None:
            if found.size:
                yield found

    def _next(self) -> Packet | None:
        """Return the next packet, one of size 0 for a skipped corrupt packet, None if none is complete."""
        buffer = self._buffer
        start = buffer.find(HEADER)
        if start < 0:
            # The last bytes may be the beginning of a header.
            del buffer[: max(0, len(buffer) - len(HEADER) + 1)]
            return None
        del buffer[:start]
        if len(buffer) < 7:
            return None
        length = int.from_bytes(buffer[5:7], "little")
        if not _LEAST_LENGTH <= length <= _MOST_LENGTH:
            return self._broken()
        size = 7 + length
        if len(buffer) < size:
            # Stuffing keeps headers out of bodies. So a header here begins the next packet, and this packet
            # is incomplete.
            return self._broken() if buffer.find(HEADER, len(HEADER)) > 0 else None
        whole = bytes(buffer[:size])
        if crc(whole[:-2]) != int.from_bytes(whole[-2:], "little"):
            return self._broken()
        del buffer[:size]
        body = whole[7:-2].replace(_STUFFED, _PLAIN)
        if body[0] == _STATUS:
            return Packet(0, 0, b"", 0)
        return Packet(whole[4], body[0], body[1:], size)

    def _broken(self) -> Packet:
        """Skip only the header of a corrupt packet, because a valid packet may begin inside it."""
        self.errors += 1
        del self._buffer[: len(HEADER)]
        return Packet(0, 0, b"", 0)


def protocol_1_requests(data: bytes) -> Iterable[tuple[int, int, bytes]]:
    """Yield id, instruction and parameters of the protocol 1.0 packets in some bytes."""
    at = 0
    while (at := data.find(b"\xff\xff", at)) >= 0 and at + 6 <= len(data):
        servo, length = data[at + 2], data[at + 3]
        body = data[at + 2 : at + 3 + length]
        end = at + 3 + length
        if length >= 2 and end < len(data) and (~sum(body) & 0xFF) == data[end]:
            yield servo, body[2], body[3:]
            at = end
        at += 1


def protocol_1_status(servo: int, data: bytes) -> bytes:
    """Return a protocol 1.0 status packet without error."""
    body = bytes([servo, len(data) + 2, 0]) + data
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
