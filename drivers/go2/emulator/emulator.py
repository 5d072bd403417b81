"""An emulated Go2 on a topic transport in real time: the device core behind ``deal-hw emulate go2``."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.drivers.go2.emulator.device import PUBLISHED, SUBSCRIBED, Go2Device
from deal_hw.drivers.transports.topic_emulator import TopicEmulator
from deal_hw.transport import TopicTransport


class Go2Emulator(TopicEmulator):
    """Runs an emulated Go2 behind a transport.

    Args:
        device: The device.
        transport: Its wire; not opened yet.
        clock: Real time.
    """

    def __init__(self, device: Go2Device, transport: TopicTransport, clock: Clock | None = None) -> None:
        published = PUBLISHED if device.sport_on_wire else PUBLISHED[:-1]
        super().__init__(device, transport, published, SUBSCRIBED, clock)
