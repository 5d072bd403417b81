"""A device core on a virtual wire: real bytes, virtual time, faster than real time."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from deal_hw.drivers.transports.virtual_wire import TickingCore, VirtualWire
from deal_hw.transport import Message


class DeviceCore(TickingCore, Protocol):
    """The required methods of a device: bytes in, bytes out, in device time."""

    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""
        ...

    def tick(self) -> bytes:
        """Run one control tick; return the bytes sent in it."""
        ...


@runtime_checkable
class TimedCore(Protocol):
    """A device that also keeps the time between ticks, such as servos that measure when they are asked."""

    def set_time(self, device_ns: int) -> None:
        """Take the time [ns], after all ticks up to it."""
        ...


class VirtualTransport(VirtualWire[DeviceCore]):
    """A virtual wire that carries a stream of bytes."""

    def send(self, message: Message) -> None:
        """Give bytes to the device, at the time of the clock, which may lie between two ticks."""
        self._check()
        self.run_ticks()
        if isinstance(self.device, TimedCore):
            self.device.set_time(self._clock.now_ns() - self._origin_ns)
        self.device.receive(message.payload)

    def inject(self, data: bytes, *, seen: bool) -> None:
        """Let another program send bytes to the device now.

        Args:
            data: The bytes.
            seen: Whether the host receives them, too, as on a bus.
        """
        self.run_ticks()
        self.device.receive(data)
        if seen:
            self._queue.append(Message("", data, self._clock.now_ns()))

    def _run_tick(self, tick_ns: int) -> None:
        if data := self.device.tick():
            self._queue.append(Message("", data, tick_ns))
