"""Contract of a transport: a path for bytes or messages."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from types import TracebackType
from typing import Self


@dataclass(frozen=True, slots=True)
class Message:
    """Bytes with their channel.

    Attributes:
        channel: CAN id, topic or key; "" for a byte stream.
        payload: The bytes.
        stamp_ns: Host clock at reception or sending [ns].
    """

    channel: str
    payload: bytes
    stamp_ns: int


class Transport(abc.ABC):
    """A path for bytes or messages. The constructor does no I/O; ``open`` and ``close`` are idempotent."""

    @abc.abstractmethod
    def open(self) -> None:
        """Open the path.

        Raises:
            PortNotFoundError: There is no such port.
            PortBusyError: Somebody else holds it.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the path."""

    @abc.abstractmethod
    def send(self, message: Message) -> None:
        """Send at once, without waiting for the peer.

        Raises:
            TransportLostError: The peer vanished.
            TransportTimeoutError: The path takes no more bytes.
        """

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> Message:
        """Return what arrived; for a byte stream, all bytes at hand (at least one).

        Args:
            timeout_s: How long to wait for the first byte [s]; 0 polls.

        Raises:
            TransportTimeoutError: Nothing arrived in time.
            TransportLostError: The peer vanished.
        """

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
