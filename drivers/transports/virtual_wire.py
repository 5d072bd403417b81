"""Common part of virtual wires: couples a device to a virtual clock."""

from __future__ import annotations

import abc
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from deal_hw.clock import VirtualClock
from deal_hw.errors import TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, Transport


class TickingCore(Protocol):
    """A device whose time passes in ticks."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...


CoreT = TypeVar("CoreT", bound=TickingCore)


class VirtualWire(Transport, Generic[CoreT]):
    """Couples a device core to a virtual clock.

    The device runs on between calls: after any change of the clock, the next call runs the missing ticks.
    Waiting in :meth:`receive` moves the clock, one device tick after the other, until a message arrives or
    the time has passed. A message's stamp is the time at which the device sent it.

    Attributes:
        device: The device.
        after_tick: Called after each tick of the device with its time [ns].

    Args:
        device: The device; its time 0 is the clock's time now.
        clock: The clock that everybody shares.
        queue_size: Most messages kept for a host that does not read; the oldest are dropped.
    """

    def __init__(self, device: CoreT, clock: VirtualClock, queue_size: int = 4096) -> None:
        self.device = device
        self.after_tick: Callable[[int], None] = lambda tick_ns: None
        self._clock = clock
        self._origin_ns = clock.now_ns() - device.device_ns
        self._queue: deque[Message] = deque(maxlen=queue_size)
        self._is_open = self._unplugged = False

    def open(self) -> None:
        """Open the wire and discard messages sent before."""
        if self._unplugged:
            raise TransportLostError("virtual wire: the device was unplugged")
        if not self._is_open:
            self.run_ticks()
            self._queue.clear()
            self._is_open = True

    def close(self) -> None:
        """Close the wire; the device runs on."""
        self._is_open = False

    def unplug(self) -> None:
        """Unplug the wire: every later call fails as if the device had vanished."""
        self._unplugged = True

    def plug_in(self) -> None:
        """Plug the wire in: it can be opened again."""
        self._unplugged = False

    def receive(self, timeout_s: float) -> Message:
        """Return the oldest message, moving the clock up to ``timeout_s`` if there is none yet."""
        self._check()
        self.run_ticks()
        deadline_ns = self._clock.now_ns() + max(0, round(timeout_s * 1e9))
        while not self._queue:
            tick_ns = self.next_tick_ns
            if tick_ns > deadline_ns:
                self._clock.sleep_until_ns(deadline_ns)
                raise TransportTimeoutError(f"virtual wire: nothing arrived within {timeout_s:g} s")
            self._clock.sleep_until_ns(tick_ns)
            self._run_tick(tick_ns)
            self.after_tick(tick_ns)
        return self._queue.popleft()

    @property
    def next_tick_ns(self) -> int:
        """Time of the device's next tick, by the shared clock [ns]."""
        return self._origin_ns + self.device.device_ns

    def run_ticks(self) -> None:
        """Run the ticks that are due by the clock."""
        now_ns = self._clock.now_ns()
        while (tick_ns := self.next_tick_ns) <= now_ns:
            self._run_tick(tick_ns)
            self.after_tick(tick_ns)

    @abc.abstractmethod
    def _run_tick(self, tick_ns: int) -> None:
        """Run one tick of the device and queue what it sends, stamped with that time [ns]."""

    def _check(self) -> None:
        if self._unplugged:
            raise TransportLostError("virtual wire: the device vanished")
        if not self._is_open:
            raise TransportLostError("virtual wire: not open")
