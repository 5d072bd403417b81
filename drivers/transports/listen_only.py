"""Transports that only listen. A dry run uses these, so that no part of it can send."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NoReturn

from deal_hw.errors import SafetyError
from deal_hw.transport import Message, TopicEnd, TopicTransport, Transport, TransportWrapper


class ListenOnly(TransportWrapper):
    """Wraps a transport; sending through it raises an error, and nothing is sent.

    Args:
        inner: The transport that could send.
    """

    can_send = False

    def send(self, message: Message) -> NoReturn:
        """Refuse to send.

        Raises:
            SafetyError: Always.
        """
        raise SafetyError(f"{self.port}: this run only listens (--dry-run), so it cannot send")


class ListenOnlyTopics(ListenOnly, TopicTransport):
    """Wraps a transport of topics; no publisher is declared, so peers do not see one either.

    Args:
        inner: The transport that could send.
    """

    def __init__(self, inner: TopicTransport) -> None:
        super().__init__(inner)
        self._topics = inner

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the topics to receive; those to publish are left out."""
        self._topics.declare(subscribe=subscribe)

    def name_types(self, types: Mapping[str, str]) -> None:
        """Name the types of topics that have another type than usual."""
        self._topics.name_types(types)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return a description of each other participant that is known to write a topic."""
        return self._topics.writers(topic)

    def ends(self, topic: str) -> tuple[TopicEnd, ...] | None:
        """Return the writers and readers of a topic in other programs; None: unknown."""
        return self._topics.ends(topic)


def listen_only(transport: Transport) -> Transport:
    """Return the transport without its way to send."""
    return ListenOnlyTopics(transport) if isinstance(transport, TopicTransport) else ListenOnly(transport)
