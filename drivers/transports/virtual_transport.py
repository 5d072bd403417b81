"""A device core on a virtual wire: real bytes, virtual time, faster than real time."""

from __future__ import annotations

from typing import Protocol

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


class VirtualTransport(VirtualWire[DeviceCore]):
    """A virtual wire that carries a stream of bytes."""

    def send(self, message: Message) -> None:
        """Give bytes to the device; its next tick handles them."""
        self._check()
        self._catch_up()
        self.device.receive(message.payload)

    def _run_tick(self, tick_ns: int) -> None:
        if data := self.device.tick():
            self._queue.append(Message("", data, tick_ns))
