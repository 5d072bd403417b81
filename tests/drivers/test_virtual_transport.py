"""The virtual wire fulfils the transport contract and keeps device and clock together."""

from collections.abc import Iterator

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import TransportTimeoutError
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.transport_suite import TransportPair, TransportSuite
from deal_hw.transport import Message


class TestVirtualTransport(TransportSuite):
    @pytest.fixture
    def pair(self) -> Iterator[TransportPair]:
        core = FakeDevice()
        transport = VirtualTransport(core, VirtualClock())

        def write(data: bytes) -> None:
            core.outbox += data

        yield TransportPair(
            near=transport, write=write, read=lambda n: core.inbox[:n], unplug=transport.unplug
        )


def test_waiting_moves_the_clock_to_the_tick_that_speaks() -> None:
    """A device that speaks at its second tick ends a wait of 1 s after 1 ms, at that stamp."""
    clock = VirtualClock(7_000_000)
    core = FakeDevice()
    with VirtualTransport(core, clock) as transport:
        core.outbox = b"x"
        message = transport.receive(1.0)
    assert (message.payload, message.stamp_ns, clock.now_ns()) == (b"x", 8_000_000, 8_000_000)


def test_a_wait_without_answer_ends_exactly_at_its_deadline() -> None:
    """2.5 ms of silence move the clock by 2.5 ms and the device by its ticks at 0, 1 and 2 ms."""
    clock = VirtualClock()
    core = FakeDevice()
    with VirtualTransport(core, clock) as transport, pytest.raises(TransportTimeoutError):
        transport.receive(0.0025)
    assert (clock.now_ns(), core.device_ns) == (2_500_000, 3_000_000)


def test_the_device_catches_up_with_a_clock_that_others_moved() -> None:
    """After a sleep of 10 ms, bytes sent now meet a device whose time is 10 ms too."""
    clock = VirtualClock()
    core = FakeDevice()
    with VirtualTransport(core, clock) as transport:
        clock.sleep_until_ns(10_000_000)
        transport.send(Message("", b"a", 0))
        assert core.device_ns == 11_000_000
        assert core.inbox == b"a"
