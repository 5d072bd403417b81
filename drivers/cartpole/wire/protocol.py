"""Serial protocol of the cart-pole, version 1: bytes <-> messages of integers.

docs/reference/protocol-cartpole-serial.md describes it.

A frame on the wire is ``COBS(version, type, body, CRC-16) 00``: version and type are one byte each, all
numbers are little-endian, the CRC is CRC-16/IBM-3740 (poly 0x1021, init 0xFFFF) over version, type and body.
The zero byte occurs nowhere else, so a receiver synchronises again at the next zero.

Payloads are integers (um, urad, um/s, urad/s, mN, mN/m, mN*s/m, us), so that a microcontroller can
compute the same bits.
"""

from __future__ import annotations

import enum
import operator
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final

from cobs import cobs
from fastcrc import crc16

from deal_hw.errors import FrameError, VersionMismatchError

VERSION: Final = 1
DEVICE_KIND: Final = "cartpole"
BAUD_RATE: Final = 1_000_000
DELIMITER: Final = b"\x00"
MAX_FRAME: Final = 64
"""Longest COBS block, without its delimiter; longer ones are invalid."""
NO_COMMAND: Final = 0xFFFF_FFFF
"""Stands for "no command yet" in a state frame; never the number of a command."""


class MessageType(enum.IntEnum):
    """The type byte; the device's own messages have bit 7 set."""

    HELLO = 0x01
    ARM = 0x02
    STOP = 0x03
    HOME = 0x04
    TARGET = 0x10
    INFO = 0x81
    ACK = 0x82
    STATE = 0x90


class Result(enum.IntEnum):
    """How the device answers a request."""

    DONE = 0
    NOT_HOMED = 1
    HOMING = 2


@dataclass(frozen=True, slots=True)
class Hello:
    """Host: asks what the device is, switches its motor off and clears earlier commands; a fixed layout."""

    FORMAT: ClassVar[str] = "<B"
    TYPE: ClassVar[MessageType] = MessageType.HELLO
    request: int
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class Info:
    """Device: the answer to hello.

    Its layout never changes, so that any two versions can name the difference.

    Attributes:
        request: Number of the hello that is answered.
        kind: What the device is, at most 16 ASCII characters.
        firmware: Major, minor, patch.
        device_rate_hz: Rate of the PD loop.
        state_rate_hz: Rate of state frames.
        unique_id: Serial number of the device.
        version: The protocol version that the device speaks.
    """

    FORMAT: ClassVar[str] = "<B16s3BHHQ"
    TYPE: ClassVar[MessageType] = MessageType.INFO
    request: int
    kind: str
    firmware: tuple[int, int, int]
    device_rate_hz: int
    state_rate_hz: int
    unique_id: int
    version: int = VERSION


@dataclass(frozen=True, slots=True)
class Arm:
    """Host: let the motor follow targets; clears a latched watchdog."""

    FORMAT: ClassVar[str] = "<B"
    TYPE: ClassVar[MessageType] = MessageType.ARM
    request: int


@dataclass(frozen=True, slots=True)
class Stop:
    """Host: motor off."""

    FORMAT: ClassVar[str] = "<B"
    TYPE: ClassVar[MessageType] = MessageType.STOP
    request: int


@dataclass(frozen=True, slots=True)
class Home:
    """Host: motor off, then go to the start pose."""

    FORMAT: ClassVar[str] = "<B"
    TYPE: ClassVar[MessageType] = MessageType.HOME
    request: int


@dataclass(frozen=True, slots=True)
class Ack:
    """Device: the answer to arm, stop and home.

    Attributes:
        request: Number of the request.
        of: Type of the request.
        result: Whether it was accepted.
    """

    FORMAT: ClassVar[str] = "<BBB"
    TYPE: ClassVar[MessageType] = MessageType.ACK
    request: int
    of: MessageType
    result: Result


@dataclass(frozen=True, slots=True)
class Target:
    """Host: a position target with gains and limits.

    Attributes:
        sequence: Number of the command; the device ignores a repeated one.
        position_um: Position target of the cart.
        stiffness_mn_m: P.
        damping_mns_m: D.
        effort_limit_mn: Largest force of the device.
        speed_limit_um_s: Largest speed of the set-point.
    """

    FORMAT: ClassVar[str] = "<IiIIHI"
    TYPE: ClassVar[MessageType] = MessageType.TARGET
    sequence: int
    position_um: int
    stiffness_mn_m: int
    damping_mns_m: int
    effort_limit_mn: int
    speed_limit_um_s: int


@dataclass(frozen=True, slots=True)
class State:
    """Device: one sample.

    Attributes:
        sequence: Number of the sample.
        device_us: Device time at which the frame was made.
        cart_um: Cart position.
        cart_um_s: Cart velocity.
        pole_urad: Pole angle, 0 upright, not wrapped.
        pole_urad_s: Pole velocity.
        effort_mn: Force that the device's controller requests, after its limit.
        status: Bits of :class:`deal_hw.types.Status`.
        command_sequence: Number of the newest command received, or :data:`NO_COMMAND`.
        command_age_us: Device time since that command was received; 0 without one.
    """

    FORMAT: ClassVar[str] = "<IQiiiihBII"
    TYPE: ClassVar[MessageType] = MessageType.STATE
    sequence: int
    device_us: int
    cart_um: int
    cart_um_s: int
    pole_urad: int
    pole_urad_s: int
    effort_mn: int
    status: int
    command_sequence: int
    command_age_us: int


AnyMessage = Hello | Info | Arm | Stop | Home | Ack | Target | State

_BY_TYPE: Final[dict[int, type[AnyMessage]]] = {
    int(kind.TYPE): kind for kind in (Hello, Info, Arm, Stop, Home, Ack, Target, State)
}
_STRUCTS: Final = {number: struct.Struct("<BB" + kind.FORMAT[1:]) for number, kind in _BY_TYPE.items()}
_PLAIN: Final[dict[type[AnyMessage], tuple[Callable[..., bytes], Callable[[Any], tuple[Any, ...]]]]] = {
    kind: (_STRUCTS[kind.TYPE].pack, operator.attrgetter("TYPE", *(field.name for field in fields(kind))))
    for kind in (Arm, Stop, Home, Ack, Target, State)
}
"""Messages whose body is their fields in order: how to pack one, and its type and values."""
_TIMELESS: Final = (MessageType.HELLO, MessageType.INFO)


def encode(message: AnyMessage) -> bytes:
    """Return the message as a frame, delimiter included.

    Raises:
        FrameError: A value does not fit its field.
    """
    try:
        payload = _encode_payload(message)
    except (struct.error, UnicodeEncodeError) as error:
        raise FrameError(f"{message} does not fit its frame: {error}") from error
    return bytes(cobs.encode(payload + crc16.ibm_3740(payload).to_bytes(2, "little"))) + DELIMITER


def _encode_payload(message: AnyMessage) -> bytes:
    if isinstance(message, Hello):
        return _STRUCTS[MessageType.HELLO].pack(message.version, MessageType.HELLO, message.request)
    if not isinstance(message, Info):
        pack, values = _PLAIN[type(message)]
        return pack(VERSION, *values(message))
    kind = message.kind.encode("ascii")
    if len(kind) > 16:
        raise FrameError(f"a device kind has at most 16 characters, got {message.kind!r}")
    rates = message.device_rate_hz, message.state_rate_hz
    numbers = message.request, kind, *message.firmware, *rates, message.unique_id
    return _STRUCTS[MessageType.INFO].pack(message.version, MessageType.INFO, *numbers)


def decode(payload: bytes) -> AnyMessage:
    """Return the message in a payload (version, type, body) whose CRC was right.

    Raises:
        VersionMismatchError: Another version, and neither hello nor info.
        FrameError: Unknown type, wrong length or an invalid value.
    """
    if len(payload) < 2:
        raise FrameError(f"a payload has at least 2 bytes (version, type), got {len(payload)}")
    version, number = payload[0], payload[1]
    if version != VERSION and number not in _TIMELESS:
        raise VersionMismatchError(f"got a message of protocol version {version}; this side speaks {VERSION}")
    if (kind := _BY_TYPE.get(number)) is None:
        raise FrameError(
            f"unknown message type 0x{number:02x}; known: {', '.join(t.name for t in MessageType)}"
        )
    layout = _STRUCTS[number]
    if len(payload) != layout.size:
        raise FrameError(f"{kind.__name__}: the payload has {len(payload)} bytes, expected {layout.size}")
    values = layout.unpack(payload)[2:]
    try:
        if kind is Info:
            name = values[1].rstrip(b"\0").decode("ascii")
            return Info(values[0], name, values[2:5], values[5], values[6], values[7], version)
        if kind is Ack:
            return Ack(values[0], MessageType(values[1]), Result(values[2]))
    except ValueError as error:
        raise FrameError(f"{kind.__name__}: {error}") from error
    return Hello(values[0], version) if kind is Hello else kind(*values)


class FrameDecoder:
    """Cuts a byte stream into payloads, and skips invalid bytes.

    Attributes:
        errors: Corrupt frames so far. Bytes before the first delimiter are not counted, because a running
            stream begins in the middle of a frame.
    """

    def __init__(self) -> None:
        self.errors = 0
        self._rest = b""
        self._overrun = False
        self._synchronised = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes; return the payloads (version, type, body) that they complete."""
        *blocks, rest = (self._rest + data).split(DELIMITER)
        payloads = []
        for block in blocks:
            payload = None if self._overrun else _unwrap(block)
            if payload is not None:
                payloads.append(payload)
            elif (block or self._overrun) and self._synchronised:
                self.errors += 1
            self._overrun = False
            self._synchronised = True
        # A block without end must not fill the memory; its head shows that it is invalid.
        if len(rest) > MAX_FRAME:
            self._overrun, rest = True, b""
        self._rest = rest
        return payloads


def _unwrap(block: bytes) -> bytes | None:
    if not 4 < len(block) <= MAX_FRAME:
        return None
    try:
        data = bytes(cobs.decode(block))
    except cobs.DecodeError:
        return None
    payload = data[:-2]
    return payload if crc16.ibm_3740(payload) == int.from_bytes(data[-2:], "little") else None
