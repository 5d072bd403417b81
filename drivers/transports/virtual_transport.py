"""A device core on a virtual wire: real bytes, virtual time, faster than real time."""

from __future__ import annotations

import io
from collections import deque
from typing import Protocol

from deal_hw.clock import VirtualClock
from deal_hw.errors import TransportLostError, TransportTimeoutError
from deal_hw.transport import Message, Transport


class DeviceCore(Protocol):
    """What a virtual wire needs of a device: bytes in, bytes out, in device time."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        ...

    def tick(self) -> bytes:
        """Run one control tick; return the bytes sent in it."""
        ...


class VirtualTransport(Transport):
    """Couples a device core to a virtual clock.

    The device lives on while nobody looks: whatever moves the clock, the next call lets the device catch up.
    Waiting in :meth:`receive` moves the clock, one device tick after the other, until bytes come out or the
    time has passed. Messages carry the time at which the device sent them.

    Args:
        device: The device; its time 0 is the clock's time now.
        clock: The clock that everybody shares.
        queue_size: Messages kept for a host that does not read; the oldest go first, as in a full buffer.
    """

    def __init__(self, device: DeviceCore, clock: VirtualClock, queue_size: int = 4096) -> None:
        self.device = device
        self._clock = clock
        self._origin_ns = clock.now_ns() - device.device_ns
        self._queue: deque[Message] = deque(maxlen=queue_size)
        self._is_open = False
        self._unplugged = False

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
        """Hand bytes to the device; its next tick handles them."""
        self._check()
        self._catch_up()
        self.device.receive(message.payload)

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

    def fileno(self) -> int:
        """There is no descriptor: virtual time passes in :meth:`receive`."""
        raise io.UnsupportedOperation("a virtual wire has no file descriptor; wait in receive()")

    def _catch_up(self) -> None:
        now_ns = self._clock.now_ns()
        while (tick_ns := self._origin_ns + self.device.device_ns) <= now_ns:
            self._run_tick(tick_ns)

    def _run_tick(self, tick_ns: int) -> None:
        if data := self.device.tick():
            self._queue.append(Message("", data, tick_ns))

    def _check(self) -> None:
        if self._unplugged:
            raise TransportLostError("virtual wire: the device vanished")
        if not self._is_open:
            raise TransportLostError("virtual wire: not open")
