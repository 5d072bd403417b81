"""A device core with topics on a virtual wire: real messages, faster than real time."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports.virtual_wire import TickingCore, VirtualWire
from deal_hw.errors import ConfigurationError
from deal_hw.transport import Message, TopicEnd, TopicTransport


class TopicCore(TickingCore, Protocol):
    """The required methods of a device with topics: messages in, messages out, in device time."""

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Take a message from the host."""
        ...

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one tick; return the messages sent in it, in order."""
        ...


class VirtualTopics(VirtualWire[TopicCore], TopicTransport):
    """A virtual wire that carries messages with topics, to the only host on it.

    Attributes:
        discovered: What discovery shows of other programs, by topic; None: nothing is known.
    """

    port = "virtual"

    def __init__(self, device: TopicCore, clock: VirtualClock, queue_size: int = 4096) -> None:
        super().__init__(device, clock, queue_size)
        self._publish: frozenset[str] = frozenset()
        self._subscribe: frozenset[str] = frozenset()
        self.discovered: dict[str, tuple[TopicEnd, ...]] | None = None

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the topics to use."""
        self._publish |= frozenset(publish)
        self._subscribe |= frozenset(subscribe)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return nothing: other writers are unknown."""
        return ()

    def ends(self, topic: str) -> tuple[TopicEnd, ...] | None:
        """Return what :attr:`discovered` has."""
        return None if self.discovered is None else self.discovered.get(topic, ())

    def publish(self, topic: str, payload: bytes) -> None:
        """Let another program publish a message now."""
        self.run_ticks()
        self._arrive(topic, payload, self._clock.now_ns())

    def send(self, message: Message) -> None:
        """Give a message to the device; its next tick handles it.

        Raises:
            ConfigurationError: The topic was not declared.
            TransportLostError: The wire is not open, or was unplugged.
        """
        self._check()
        if message.channel not in self._publish:
            raise ConfigurationError(
                f"virtual wire: topic {message.channel!r} is not declared for publishing; declared: "
                f"{', '.join(sorted(self._publish)) or '(none)'}"
            )
        self.run_ticks()
        self.device.receive(message.channel, message.payload, self._clock.now_ns())

    def _run_tick(self, tick_ns: int) -> None:
        for topic, payload in self.device.tick():
            self._arrive(topic, payload, tick_ns)

    def _arrive(self, topic: str, payload: bytes, stamp_ns: int) -> None:
        if topic in self._subscribe:
            self._queue.append(Message(topic, payload, stamp_ns))
