"""Processes on one virtual wire that can be killed at any moment of virtual time.

A process has a clock and a wire of its own. Once it is killed, each call of them raises :class:`Killed`, so
that nothing of it is sent any more: neither by a ``finally``, nor by an ``except``.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

from deal_hw.clock import VirtualClock
from deal_hw.errors import ConfigurationError, TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, TopicEnd, TopicTransport, Transport

_WAITING = 4096
"""Most messages that wait for a process; the oldest are dropped."""


class Killed(BaseException):  # No error of the program: nothing may catch it.
    """The process was killed; no subclass of Exception, so that no handler of errors takes it."""


class Wire(Protocol):
    """What is needed of a virtual wire, see :mod:`deal_hw.drivers.transports.virtual_wire`."""

    device: Any
    after_tick: Callable[[int], None]

    @property
    def next_tick_ns(self) -> int:
        """Time of the device's next tick [ns]."""
        ...

    def run_ticks(self) -> None:
        """Run the ticks that are due."""
        ...

    def unplug(self) -> None:
        """Unplug the wire."""
        ...

    def plug_in(self) -> None:
        """Plug the wire in."""
        ...

    def open(self) -> None:
        """Open the wire."""
        ...

    def close(self) -> None:
        """Close the wire."""
        ...

    def reopen(self) -> None:
        """Open the wire again."""
        ...

    def send(self, message: Message) -> None:
        """Send a message."""
        ...

    def receive(self, timeout_s: float) -> Message:
        """Return the next message."""
        ...


class World:
    """A device, its wire, and what happens at given times.

    Attributes:
        clock: The clock that all share.
        wire: The wire.
        watchers: Called after each tick of the device with its time [ns].
        cut: Whether messages with topics are lost on their way, in both directions; nobody gets an error.

    Args:
        clock: As the attribute.
        wire: As the attribute.
    """

    def __init__(self, clock: VirtualClock, wire: Wire) -> None:
        self.clock, self.wire = clock, wire
        self.watchers: list[Callable[[int], None]] = []
        self.cut = self._busy = False
        self._sides: list[ProcessStream | ProcessTopics] = []
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0
        wire.after_tick = self._after_tick

    def at(self, time_ns: int, act: Callable[[], None]) -> None:
        """Do something after the first tick at or after a time [ns]."""
        self._count += 1
        heapq.heappush(self._due, (time_ns, self._count, act))

    def every(self, period_s: float, act: Callable[[], None]) -> None:
        """Do something now and again, until :meth:`calm`."""
        self._busy = True

        def again() -> None:
            if self._busy:
                act()
                self.at(self.clock.now_ns() + round(period_s * 1e9), again)

        again()

    def calm(self) -> None:
        """End what is done again and again."""
        self._busy = False

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Let time pass, one tick of the device after the other."""
        while (tick_ns := self.wire.next_tick_ns) <= deadline_ns:
            self.clock.sleep_until_ns(tick_ns)
            self.wire.run_ticks()
        self.clock.sleep_until_ns(deadline_ns)

    def publish(self, topic: str, payload: bytes) -> None:
        """Let another program publish a message, to the robot and to all processes."""
        wire: Any = self.wire
        wire.run_ticks()
        wire.device.receive(topic, payload, self.clock.now_ns())
        wire.publish(topic, payload)

    def inject(self, data: bytes, *, seen: bool) -> None:
        """Let another program send bytes, to the device; and to all processes where they are ``seen``."""
        wire: Any = self.wire
        wire.inject(data, seen=seen)

    def join(self, side: ProcessStream | ProcessTopics) -> None:
        """Take the wire of a process that opens it."""
        if not self._sides:
            self.wire.open()
        if side not in self._sides:
            self._sides.append(side)

    def leave(self, side: ProcessStream | ProcessTopics) -> None:
        """Let a process close its wire; the last one closes that of all."""
        if side in self._sides:
            self._sides.remove(side)
            if not self._sides:
                self.wire.close()

    def deliver(self, message: Message, sender: ProcessTopics | None = None) -> None:
        """Give a message with a topic to all processes but its sender."""
        if not self.cut:
            for side in self._sides:
                if side is not sender and isinstance(side, ProcessTopics):
                    side.take(message)

    def _after_tick(self, tick_ns: int) -> None:
        for watcher in self.watchers:
            watcher(tick_ns)
        while self._due and self._due[0][0] <= tick_ns:
            heapq.heappop(self._due)[2]()


class Process:
    """One process of a run: its clock, its wire, and whether it lives.

    Attributes:
        clock: Its clock.
        wire: Its wire: a stream of bytes, or topics.
        dead: Whether it was killed.

    Args:
        world: What it shares with others.
        topics: Whether its wire has topics.
    """

    def __init__(self, world: World, *, topics: bool) -> None:
        self.dead = False
        self.clock = ProcessClock(world, self)
        self.wire = ProcessTopics(world, self) if topics else ProcessStream(world, self)
        self._world = world

    def kill(self) -> None:
        """Kill it: the system closes its wire, and from now on nothing of it acts."""
        self.dead = True
        self._world.leave(self.wire)

    def check(self) -> None:
        """Raise Killed if it is dead."""
        if self.dead:
            raise Killed


class ProcessClock:
    """The clock of a process; see :class:`~deal_hw.clock.Clock`."""

    def __init__(self, world: World, process: Process) -> None:
        self._world, self._process = world, process

    def now_ns(self) -> int:
        """Return the virtual time [ns]."""
        self._process.check()
        return self._world.clock.now_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Let time pass."""
        self._process.check()
        self._world.sleep_until_ns(deadline_ns)
        self._process.check()


class ProcessStream(Transport):
    """A port of bytes that several processes have open, as an inherited one."""

    port = "virtual"

    def __init__(self, world: World, process: Process) -> None:
        self._world, self._process = world, process

    def open(self) -> None:
        """Open the port."""
        self._process.check()
        self._world.join(self)

    def close(self) -> None:
        """Close it for this process."""
        self._process.check()
        self._world.leave(self)

    def reopen(self) -> None:
        """Open the port again."""
        self._process.check()
        self._world.wire.reopen()

    def send(self, message: Message) -> None:
        """Send bytes."""
        self._process.check()
        self._world.wire.run_ticks()
        self._world.wire.send(message)

    def receive(self, timeout_s: float) -> Message:
        """Return the next bytes."""
        self._process.check()
        return self._world.wire.receive(timeout_s)


class ProcessTopics(TopicTransport):
    """Topics of one process, which also receives the messages of the others, as on a network."""

    port = "virtual"

    def __init__(self, world: World, process: Process) -> None:
        self._world, self._process = world, process
        self._publish: frozenset[str] = frozenset()
        self._subscribe: frozenset[str] = frozenset()
        self._inbox: deque[Message] = deque(maxlen=_WAITING)
        self._is_open = False

    @property
    def _wire(self) -> Any:
        return self._world.wire

    def declare(self, *, publish: Collection[str] = (), subscribe: Collection[str] = ()) -> None:
        """Declare the topics to use."""
        self._publish |= frozenset(publish)
        self._subscribe |= frozenset(subscribe)
        self._wire.declare(publish=publish, subscribe=subscribe)

    def name_types(self, types: Mapping[str, str]) -> None:
        """Do nothing: a virtual wire has no types."""

    def writers(self, topic: str) -> tuple[str, ...]:
        """Return nothing: other writers are unknown."""
        return ()

    def ends(self, topic: str) -> tuple[TopicEnd, ...] | None:
        """Return what the wire knows."""
        found: tuple[TopicEnd, ...] | None = self._wire.ends(topic)
        return found

    def open(self) -> None:
        """Take messages from now on."""
        self._process.check()
        if not self._is_open:
            self._world.join(self)
            self._settle()
            self._inbox.clear()
            self._is_open = True

    def close(self) -> None:
        """Take no more messages."""
        self._process.check()
        self._is_open = False
        self._world.leave(self)

    def reopen(self) -> None:
        """Do nothing: a network comes back by itself."""
        self._process.check()

    def send(self, message: Message) -> None:
        """Publish a message; a cut network loses it."""
        self._check()
        if message.channel not in self._publish:
            raise ConfigurationError(f"virtual wire: topic {message.channel!r} is not declared")
        self._wire.run_ticks()
        if not self._world.cut:
            self._wire.send(message)
            self._world.deliver(message, self)

    def receive(self, timeout_s: float) -> Message:
        """Return the oldest message."""
        self._check()
        clock = self._world.clock
        deadline_ns = clock.now_ns() + max(0, round(timeout_s * 1e9))
        while not self._inbox:
            left_ns = deadline_ns - clock.now_ns()
            if left_ns < 0:
                raise TransportTimeoutError(f"virtual wire: nothing arrived within {timeout_s:g} s")
            self._world.deliver(self._wire.receive(left_ns * 1e-9))
        return self._inbox.popleft()

    def take(self, message: Message) -> None:
        """Take a message of a subscribed topic."""
        if message.channel in self._subscribe:
            self._inbox.append(message)

    def _settle(self) -> None:
        """Give waiting messages to the others: they came before this process opened its topics."""
        try:
            while True:
                self._world.deliver(self._wire.receive(0.0))
        except TransportTimeoutError:
            return

    def _check(self) -> None:
        self._process.check()
        if not self._is_open:
            raise TransportLostError("virtual wire: not open")
