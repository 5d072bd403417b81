"""An emulated robot on a topic transport in real time: a device core follows the clock, tick by tick."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from typing import Any, Final, Protocol

from deal_hw.clock import Clock, MonotonicClock
from deal_hw.errors import FrameError, TransportError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport

STALL_NS: Final = 50_000_000
"""If the process is behind by more than this, device time stands still instead of catching up."""
LATE_NS: Final = 1_000_000
_MOST_MESSAGES: Final = 200
"""Most messages taken at a tick: a flood must not stop the robot's time."""


class TopicDevice(Protocol):
    """What a device core has: messages in, messages out, in device time."""

    host_origin_ns: int
    """Host clock at device time 0 [ns], which the emulator keeps correct."""

    @property
    def device_ns(self) -> int:
        """Device time at which the next tick runs [ns]."""
        ...

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Take a message from the host."""
        ...

    def advance_to(self, device_ns: int) -> list[tuple[str, bytes]]:
        """Run every tick up to a time [ns]; return the messages sent meanwhile."""
        ...

    def report(self) -> Mapping[str, Any]:
        """Return what happened, as plain JSON values."""
        ...


class TopicEmulator:
    """Runs a device core behind a transport.

    Attributes:
        slips: How often this process stalled and device time stood still.
        late: Ticks that began more than a millisecond late.
        latest_ns: Largest delay of them [ns].
        unsent: Messages that the transport did not take.

    Args:
        device: The device.
        transport: Its wire; not opened yet.
        publish: Topics that the device publishes.
        subscribe: Topics that it reads.
        clock: Real time.
    """

    def __init__(
        self,
        device: TopicDevice,
        transport: TopicTransport,
        publish: Collection[str],
        subscribe: Collection[str],
        clock: Clock | None = None,
    ) -> None:
        self.slips = self.late = self.latest_ns = self.unsent = 0
        self._device, self._transport = device, transport
        self._publish, self._subscribe = publish, subscribe
        self._clock = clock or MonotonicClock()
        self._origin_ns = 0

    def open(self) -> str:
        """Open the wire and start device time; return the port.

        Raises:
            TransportError: The wire cannot be opened.
        """
        self._transport.declare(publish=self._publish, subscribe=self._subscribe)
        self._transport.open()
        self._origin_ns = self._device.host_origin_ns = self._clock.now_ns() - self._device.device_ns
        return str(getattr(self._transport, "port", ""))

    def close(self) -> None:
        """Close the wire."""
        self._transport.close()

    def step(self) -> bool:
        """Sleep until the next tick is due, take received messages, and run every tick that is due."""
        due_ns = self._origin_ns + self._device.device_ns
        self._clock.sleep_until_ns(due_ns)
        self._take()
        now_ns = self._clock.now_ns()
        late_ns = now_ns - due_ns
        if late_ns > LATE_NS:
            self.late += 1
            self.latest_ns = max(self.latest_ns, late_ns)
        if late_ns > STALL_NS:
            # If it caught up, it would send a burst of states, which no robot does.
            self._origin_ns += late_ns
            self._device.host_origin_ns = self._origin_ns
            self.slips += 1
        for topic, payload in self._device.advance_to(now_ns - self._origin_ns):
            try:
                self._transport.send(Message(topic, payload, now_ns))
            except (TransportError, FrameError):
                # DDS checks the CDR header, which a fault may have changed: such a message is lost.
                self.unsent += 1
        return True

    def report(self) -> dict[str, Any]:
        """Return the device's report and the timing, as plain JSON values."""
        return {
            **self._device.report(),
            "origin_host_ns": self._origin_ns,
            "slips": self.slips,
            "late_ticks": self.late,
            "latest_ms": self.latest_ns / 1e6,
            "unsent": self.unsent,
        }

    def _take(self) -> None:
        with contextlib.suppress(TransportTimeoutError):
            for _ in range(_MOST_MESSAGES):
                message = self._transport.receive(0.0)
                self._device.receive(message.channel, message.payload, message.stamp_ns)
