"""An emulated robot of Unitree on DDS or Zenoh in real time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from deal_hw.clock import Clock
from deal_hw.drivers.transports.topic_emulator import TopicDevice, TopicEmulator
from deal_hw.transport import TopicTransport


class DeviceOnTopics(TopicDevice, Protocol):
    """A device core that knows its topics."""

    @property
    def published(self) -> tuple[str, ...]:
        """Topics that it writes."""
        ...

    @property
    def subscribed(self) -> tuple[str, ...]:
        """Topics that it reads."""
        ...

    @property
    def types(self) -> Mapping[str, str]:
        """Types of the topics that have another type than the Go2's."""
        ...


class UnitreeEmulator(TopicEmulator):
    """Runs a robot's device core behind a transport.

    Args:
        device: The device.
        transport: Its wire; not opened yet.
        clock: Real time.
    """

    def __init__(self, device: DeviceOnTopics, transport: TopicTransport, clock: Clock | None = None) -> None:
        transport.name_types(device.types)
        super().__init__(device, transport, device.published, device.subscribed, clock)
