"""A device for a virtual wire that sends the bytes that a test chooses."""

from __future__ import annotations


class FakeDevice:
    """Answers each message with the same bytes, in its next tick of 1 ms; goes behind a ``VirtualTransport``.

    Attributes:
        device_ns: Time of the next tick [ns].
        inbox: All bytes received so far.
        outbox: Bytes that the next tick sends.

    Args:
        answer: The answer to each message; none by default.
    """

    def __init__(self, answer: bytes = b"") -> None:
        self.device_ns = 0
        self.inbox = self.outbox = b""
        self._answer = answer

    def receive(self, data: bytes) -> None:
        """Keep the bytes, and answer them."""
        self.inbox += data
        self.outbox += self._answer

    def tick(self) -> bytes:
        """Send the waiting bytes once."""
        self.device_ns += 1_000_000
        out, self.outbox = self.outbox, b""
        return out
