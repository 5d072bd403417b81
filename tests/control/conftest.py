"""A cart-pole on a virtual wire."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.data.recording.record import CycleRecord
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.transports.virtual_transport import VirtualTransport


class VirtualRig:
    """A nominal cart-pole on a virtual wire, with what came out of it."""

    def __init__(self) -> None:
        self.clock = VirtualClock(10**9)
        self.device = CartpoleDevice(nominal_truth("ideal"), keep_truth=True)
        self.transport = VirtualTransport(self.device, self.clock)
        self.robot = CartpoleRobot(self.transport, self.clock)
        self.records: list[CycleRecord] = []

    def sink(self, record: CycleRecord) -> bool:
        """Keep a record."""
        self.records.append(record)
        return True

    @property
    def events(self) -> list[tuple[str, str]]:
        """Kind and message of all events."""
        return [(event.kind, event.message) for record in self.records for event in record.events]


@pytest.fixture
def rig() -> Iterator[VirtualRig]:
    """A cart-pole on a virtual wire; whatever a test does to it, its motor is off at the end."""
    made = VirtualRig()
    yield made
    assert not made.device.armed
