"""A device core that speaks in topics, on a virtual wire: real messages, faster than real time."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Protocol

from deal_hw.clock import VirtualClock
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport


class TopicCore(Protocol):
    """What a virtual wire needs of a device: messages in, messages out, in device time."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Take a message from the host."""
        ...

    def tick(self) -> list[tuple[str, bytes]]:
        """Run one tick; return the messages sent in it, in order."""
        ...


class VirtualTopics(TopicTransport):
    """Couples a device core to a virtual clock, as the only host on its wire.

    The device lives on while nobody looks: whatever moves the clock, the next call lets it catch up.
    Waiting in :meth:`receive` moves the clock, one device tick after the other, until a message of a declared
    topic comes or the time has passed. Messages carry the time at which the device sent them.

    Args:
        device: The device; its time 0 is the clock's time now.
        clock: The clock that everybody shares.
        queue_size: Messages kept for a host that does not read; the oldest go first.
    """

    port = "virtual"

    def __init__(self, device: TopicCore, clock: VirtualClock, queue_size: int = 4096) -> None:
        self.device = device
        self._clock = clock
        self._origin_ns = clock.now_ns() - device.device_ns
        self._queue: deque[Message] = deque(maxlen=queue_size)
        self._publish: frozenset[str] = frozenset()
        self._subscribe: frozenset[str] = frozenset()
        self._is_open = self._unplugged = False

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Say which topics will be used."""
        self._publish |= frozenset(publish)
        self._subscribe |= frozenset(subscribe)

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return nothing: who else is on the wire is not known."""
        return ()

    def open(self) -> None:
        """Open the wire and forget what the device had sent before."""
        if self._unplugged:
            raise TransportLostError("virtual wire: the device was unplugged")
        if not self._is_open:
            self._catch_up()
            self._queue.clear()
            self._is_open = True

    def close(self) -> None:
        """Close the wire; the device lives on."""
        self._is_open = False

    def unplug(self) -> None:
        """Pull the cable: every later call fails as if the device had vanished."""
        self._unplugged = True

    def send(self, message: Message) -> None:
        """Hand a message to the device; its next tick handles it.

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
        self._catch_up()
        self.device.receive(message.channel, message.payload, self._clock.now_ns())

    def receive(self, timeout_s: float) -> Message:
        """Return the oldest message, moving the clock up to ``timeout_s`` if there is none yet."""
        self._check()
        self._catch_up()
        deadline_ns = self._clock.now_ns() + max(0, round(timeout_s * 1e9))
        while not self._queue:
            tick_ns = self._origin_ns + self.device.device_ns
            if tick_ns > deadline_ns:
                self._clock.sleep_until_ns(deadline_ns)
                raise TransportTimeoutError(f"virtual wire: nothing arrived within {timeout_s:g} s")
            self._clock.sleep_until_ns(tick_ns)
            self._run_tick(tick_ns)
        return self._queue.popleft()

    def _catch_up(self) -> None:
        now_ns = self._clock.now_ns()
        while (tick_ns := self._origin_ns + self.device.device_ns) <= now_ns:
            self._run_tick(tick_ns)

    def _run_tick(self, tick_ns: int) -> None:
        for topic, payload in self.device.tick():
            if topic in self._subscribe:
                self._queue.append(Message(topic, payload, tick_ns))

    def _check(self) -> None:
        if self._unplugged:
            raise TransportLostError("virtual wire: the device vanished")
        if not self._is_open:
            raise TransportLostError("virtual wire: not open")
