"""Links encode messages as bytes and decode them: the interfaces of both sides, and the serial wire."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Protocol

from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.errors import ProtocolError


class Link(Protocol):
    """One side of a wire: decodes the peer's bytes and encodes messages.

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
        fault: Fault after which the host must not continue, such as two devices with one number; "" for none.
        resync: Bytes that end an incomplete frame, so that the receiver does not join it with the next one.
        hint: Advice for the case that bytes arrive but no answer.
    """

    def feasible(self, target: protocol.Target) -> protocol.Target:
        """Return the target as this wire will send it next."""
        ...

    @property
    def fault(self) -> str:
        """Fault after which the host must not continue; "" for none."""
        ...

    @property
    def resync(self) -> bytes:
        """Bytes that end an incomplete frame."""
        ...

    @property
    def hint(self) -> str:
        """Advice for the case that bytes arrive but no answer."""
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
        """Return the target unchanged: this wire carries all of it."""
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
