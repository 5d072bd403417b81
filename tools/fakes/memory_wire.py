"""One end of a wire of topics; the other end is two lists, of messages to receive and of messages sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from deal_hw.errors import TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport


class MemoryWire(TopicTransport):
    """Returns the messages that a test put into it.

    Attributes:
        arriving: Messages to receive.
        sent: Messages sent.
        is_open: Whether it is open.
        broken: Whether sending fails.
    """

    def __init__(self) -> None:
        self.published: set[str] = set()
        self.subscribed: set[str] = set()
        self.arriving: deque[Message] = deque()
        self.sent: list[Message] = []
        self.is_open = self.broken = False

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Note the topics."""
        self.published |= set(publish)
        self.subscribed |= set(subscribe)

    def open(self) -> None:
        """Open it."""
        self.is_open = True

    def close(self) -> None:
        """Close it."""
        self.is_open = False

    def send(self, message: Message) -> None:
        """Keep a message of a topic that was declared.

        Raises:
            TransportLostError: The wire is broken.
        """
        assert message.channel in self.published
        if self.broken:
            raise TransportLostError("cut")
        self.sent.append(message)

    def receive(self, timeout_s: float) -> Message:
        """Return the first message.

        Raises:
            TransportTimeoutError: There is none.
        """
        if not self.arriving:
            raise TransportTimeoutError("nothing")
        return self.arriving.popleft()

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return no writer."""
        return ()
