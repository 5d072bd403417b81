"""How messages become bytes on a wire and back: what host and device share, and the serial wire."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Protocol

from deal_hw.drivers.cartpole import protocol
from deal_hw.errors import ProtocolError


class Link(Protocol):
    """One side of a wire: what the peer's bytes say, and how a message is written.

    Attributes:
        errors: Corrupt frames so far.
    """

    errors: int

    def decode(self, data: bytes) -> Iterable[protocol.AnyMessage]:
        """Take bytes; return the messages that they complete, and count what is none."""
        ...

    def encode(self, message: protocol.AnyMessage) -> bytes:
        """Return the bytes of a message."""
        ...


class HostLink(Link, Protocol):
    """The host's side.

    Attributes:
        fault: What was heard that forbids going on, such as two devices under one number; "" for nothing.
        resync: Bytes that keep a frame that was cut short from swallowing the next one.
        hint: What to check where bytes come but no answer.
    """

    def feasible(self, target: protocol.Target) -> protocol.Target:
        """Return what of a target this wire carries, as it will be sent next."""
        ...

    @property
    def fault(self) -> str:
        """What was heard that forbids going on."""
        ...

    @property
    def resync(self) -> bytes:
        """Bytes that end a frame that was cut short."""
        ...

    @property
    def hint(self) -> str:
        """What to check where bytes come but no answer."""
        ...


class SerialLink:
    """COBS frames with a CRC, as on the serial wire."""

    resync: ClassVar[bytes] = protocol.DELIMITER
    hint: ClassVar[str] = f"check for another device on it, or another baud rate than {protocol.BAUD_RATE}"

    def __init__(self) -> None:
        self.fault = ""
        self._decoder = protocol.FrameDecoder()

    @property
    def errors(self) -> int:
        """Corrupt frames so far."""
        return self._decoder.errors

    @errors.setter
    def errors(self, count: int) -> None:
        self._decoder.errors = count

    def feasible(self, target: protocol.Target) -> protocol.Target:
        """Return what of a target this wire carries: all of it."""
        return target

    def decode(self, data: bytes) -> Iterable[protocol.AnyMessage]:
        """Take bytes; return the messages that they complete, and count what is none."""
        for payload in self._decoder.feed(data):
            try:
                yield protocol.decode(payload)
            except ProtocolError:
                self._decoder.errors += 1

    def encode(self, message: protocol.AnyMessage) -> bytes:
        """Return the bytes of a message."""
        return protocol.encode(message)
