"""A port that was opened as another wire: the doctor says what answers there."""

from __future__ import annotations

import pytest

from deal_hw.clock import Clock, VirtualClock
from deal_hw.drivers.cartpole.chips.device import EmulatedDevice
from deal_hw.drivers.cartpole.chips.firmwares import device_of
from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.emulator.can_emulator import can_device
from deal_hw.drivers.cartpole.emulator.faults import CanFaults
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.wire.other_wires import name_other_wire
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import PortBusyError
from deal_hw.findings import Finding, Severity
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.transport import Transport

pytestmark = pytest.mark.real_time

SLCAN, SERVOS, SERIAL = (
    "a serial CAN adapter",
    "Dynamixel servos (id 1, 2 at",
    "a device with deal-hw's serial",
)


def device(what: str) -> EmulatedDevice | SlcanAdapter:
    """Return what is at the port."""
    truth = nominal_truth("ideal")
    match what:
        case "adapter":
            return SlcanAdapter([can_device(truth)], CanFaults())
        case "servos":
            return DynamixelDevice(truth)
    return device_of(truth, "python")


def found(what: str, transport: str, port: str = "/dev/x") -> list[Finding]:
    """Return the findings on a port."""
    clock, there = VirtualClock(), device(what)

    def make(path: str, rate: int, _: Clock) -> Transport:
        assert path == "/dev/x"
        if isinstance(there, DynamixelDevice):
            there.bus.host_baud_rate = rate
        return VirtualTransport(there, clock)

    return list(name_other_wire(port, transport, clock, make))


@pytest.mark.parametrize(
    ("what", "transport", "says", "remedy"),
    [
        ("adapter", "serial", SLCAN, "--transport can --port slcan:/dev/x or --transport odrive"),
        ("adapter", "dynamixel", SLCAN, "--transport can --port slcan:/dev/x"),
        ("servos", "serial", SERVOS, "--transport dynamixel --port /dev/x"),
        ("servos", "can", SERVOS, "--transport dynamixel --port /dev/x"),
        ("cart-pole", "can", SERIAL, "--transport serial --port /dev/x"),
        ("cart-pole", "odrive", SERIAL, "--transport serial --port /dev/x"),
        ("cart-pole", "dynamixel", SERIAL, "--transport serial --port /dev/x"),
    ],
)
def test_the_wire_of_a_port_is_named(what: str, transport: str, says: str, remedy: str) -> None:
    """What answers, that it was opened as another wire, and the arguments to use instead."""
    (finding,) = found(what, transport, "slcan:/dev/x?bitrate=500000" if transport == "can" else "/dev/x")
    assert finding.severity is Severity.FAIL
    assert says in finding.seen
    assert f"--transport {transport} is the wrong wire" in finding.seen
    assert remedy in finding.do


@pytest.mark.parametrize(("what", "transport"), [("adapter", "odrive"), ("servos", "dynamixel")])
def test_the_right_wire_is_not_doubted(what: str, transport: str) -> None:
    """Its fault is another one, and was reported already."""
    assert found(what, transport) == []


def test_silence_and_ports_that_cannot_be_opened_yield_nothing() -> None:
    """Nothing answers, another program has the port, or it is no serial port."""
    clock = VirtualClock()
    assert list(name_other_wire("can0?node=3", "can", clock)) == []
    silent = VirtualTransport(FakeDevice(b""), clock)
    assert list(name_other_wire("/dev/x", "serial", clock, lambda *_: silent)) == []

    def busy(path: str, rate: int, clock: Clock) -> Transport:
        raise PortBusyError(f"{path} is in use")

    assert list(name_other_wire("/dev/x", "serial", clock, busy)) == []
