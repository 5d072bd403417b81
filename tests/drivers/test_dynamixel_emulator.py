"""Emulated servos on a pty: other people's client, ROBOTIS' SDK as its examples use it, and the doctor."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)

from deal_hw.clock import Clock, MonotonicClock, VirtualClock
from deal_hw.drivers.cartpole.dynamixel.connect import dynamixel_robot, parse_port
from deal_hw.drivers.cartpole.dynamixel.device import DynamixelDevice
from deal_hw.drivers.cartpole.dynamixel.doctor import examine_servos
from deal_hw.drivers.cartpole.dynamixel.emulator import ServoEmulator, dynamixel_emulator
from deal_hw.drivers.cartpole.dynamixel.robot import DynamixelCartpole
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.emulator.faults import Hazards, ServoFaults
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.servo_bus.emulated_servo import BOOT_NS
from deal_hw.drivers.transports.serial_transport import SerialTransport
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import ConfigurationError, PortNotFoundError
from deal_hw.findings import Finding, Severity
from deal_hw.robots.connect import make_robot
from deal_hw.transport import Transport

pytestmark = pytest.mark.real_time

TORQUE_ENABLE, LED, GOAL_POSITION, PRESENT_POSITION, REALTIME_TICK = 64, 65, 116, 132, 120

PATIENT = "?answer_s=0.3"
"""A busy machine may take its time."""


@contextmanager
def emulated(faults: ServoFaults | None = None) -> Iterator[tuple[str, ServoEmulator]]:
    """Run emulated servos in a thread; yield the port and the emulator."""
    hazards = Hazards(servo=faults or ServoFaults())
    emulator = dynamixel_emulator(nominal_truth(), link=None, hazards=hazards)
    port, ended = emulator.open(), threading.Event()

    def run() -> None:
        while not ended.is_set():
            emulator.step()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield port, emulator
    finally:
        ended.set()
        thread.join()
        emulator.close()


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[PortHandler, PacketHandler]]:
    """Open the emulated servos as the SDK's examples do; a busy machine may take its time."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 200)
    with emulated() as (path, _):
        port = PortHandler(path)
        assert port.openPort()
        assert port.setBaudRate(1_000_000)
        yield port, PacketHandler(2.0)
        port.closePort()


def test_ping_and_broadcast_ping(sdk: tuple[PortHandler, PacketHandler]) -> None:
    """ping.py and broadcast_ping.py: both servos, model 1190 (XL330-M077), firmware 46; nobody at id 3."""
    port, packets = sdk
    assert packets.ping(port, 1) == (1190, COMM_SUCCESS, 0)
    assert packets.ping(port, 3)[1] == COMM_RX_TIMEOUT
    assert packets.broadcastPing(port) == ({1: [1190, 46], 2: [1190, 46]}, COMM_SUCCESS)


def test_read_and_write(sdk: tuple[PortHandler, PacketHandler]) -> None:
    """read_write.py: torque on, a goal, the position; what a servo refuses comes back with the reason."""
    port, packets = sdk
    assert packets.write1ByteTxRx(port, 1, TORQUE_ENABLE, 1) == (COMM_SUCCESS, 0)
    position, result, error = packets.read4ByteTxRx(port, 1, PRESENT_POSITION)
    assert (result, error) == (COMM_SUCCESS, 0)
    assert packets.write4ByteTxRx(port, 1, GOAL_POSITION, position) == (COMM_SUCCESS, 0)
    assert packets.read4ByteTxRx(port, 1, GOAL_POSITION)[0] == position
    # Access error: Operating Mode while the torque is on, and a register that only reads.
    assert packets.write1ByteTxRx(port, 1, 11, 3) == (COMM_SUCCESS, 7)
    assert packets.write4ByteTxRx(port, 1, PRESENT_POSITION, 0) == (COMM_SUCCESS, 7)
    # Data range error.
    assert packets.write1ByteTxRx(port, 1, TORQUE_ENABLE, 2) == (COMM_SUCCESS, 4)
    assert packets.write1ByteTxRx(port, 1, TORQUE_ENABLE, 0) == (COMM_SUCCESS, 0)


def test_sync_and_bulk(sdk: tuple[PortHandler, PacketHandler]) -> None:
    """sync_read_write.py, fast_sync_read_write.py and bulk_read_write.py."""
    port, packets = sdk
    leds = GroupSyncWrite(port, packets, LED, 1)
    assert leds.addParam(1, [1])
    assert leds.addParam(2, [0])
    assert leds.txPacket() == COMM_SUCCESS
    for read in ("txRxPacket", "fastSyncRead"):
        group = GroupSyncRead(port, packets, LED, 1)
        assert group.addParam(1)
        assert group.addParam(2)
        assert getattr(group, read)() == COMM_SUCCESS
        assert [group.getData(servo, LED, 1) for servo in (1, 2)] == [1, 0]
    bulk_write = GroupBulkWrite(port, packets)
    assert bulk_write.addParam(1, LED, 1, [0])
    assert bulk_write.addParam(2, GOAL_POSITION, 4, [0x34, 0x12, 0, 0])
    assert bulk_write.txPacket() == COMM_SUCCESS
    for read in ("txRxPacket", "fastBulkRead"):
        bulk = GroupBulkRead(port, packets)
        assert bulk.addParam(1, LED, 1)
        assert bulk.addParam(2, GOAL_POSITION, 4)
        assert getattr(bulk, read)() == COMM_SUCCESS
        assert (bulk.getData(1, LED, 1), bulk.getData(2, GOAL_POSITION, 4)) == (0, 0x1234)


def test_registered_writes_and_reboot(sdk: tuple[PortHandler, PacketHandler]) -> None:
    """Reg Write waits for Action; Reboot forgets what is in RAM, and the servo is silent while it starts."""
    port, packets = sdk
    assert packets.regWriteTxRx(port, 2, LED, 1, [1]) == (COMM_SUCCESS, 0)
    assert packets.read1ByteTxRx(port, 2, LED)[0] == 0
    assert packets.action(port, 2) == COMM_SUCCESS
    assert packets.read1ByteTxRx(port, 2, LED)[0] == 1
    assert packets.reboot(port, 2) == (COMM_SUCCESS, 0)
    assert packets.read1ByteTxRx(port, 2, LED)[1] == COMM_RX_TIMEOUT
    # Each try waits 0.4 s for a servo that is silent for 0.3 s.
    assert BOOT_NS < 400_000_000
    assert any(packets.ping(port, 2)[1] == COMM_SUCCESS for _ in range(10))
    assert packets.read1ByteTxRx(port, 2, LED)[0] == 0


def test_the_return_delay_is_kept(sdk: tuple[PortHandler, PacketHandler]) -> None:
    """A servo with a delay still answers; the register keeps it over a restart, as EEPROM does."""
    port, packets = sdk
    assert packets.write1ByteTxRx(port, 1, 9, 250) == (COMM_SUCCESS, 0)
    packets.reboot(port, 1)
    assert any(packets.ping(port, 1)[1] == COMM_SUCCESS for _ in range(10))
    assert packets.read1ByteTxRx(port, 1, 9) == (250, COMM_SUCCESS, 0)


def test_a_port_of_another_rate_hears_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Servos at 57600 baud are deaf at a million, and answer at their own rate."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 200)
    with emulated(ServoFaults(servo_baud_rate=57600)) as (path, _):
        port = PortHandler(path)
        port.setBaudRate(1_000_000)
        assert PacketHandler(2.0).ping(port, 1)[1] == COMM_RX_TIMEOUT
        port.setBaudRate(57600)
        assert PacketHandler(2.0).ping(port, 1)[1] == COMM_SUCCESS
        port.closePort()


def findings(faults: ServoFaults, tmp_path: Path) -> list[Finding]:
    """Return what the doctor finds on emulated servos, whose silence takes no time."""
    clock = VirtualClock()
    device = DynamixelDevice(nominal_truth(), DynamixelSettings(baud_rate=faults.servo_baud_rate), faults)

    def at(path: str, rate: int, _: Clock) -> Transport:
        device.bus.host_baud_rate = rate
        return VirtualTransport(device, clock)

    return list(examine_servos("servos", clock, tmp_path, at))


def test_doctor_lists_servos(tmp_path: Path) -> None:
    """Role, model, firmware, rate, mode, position and voltage of each."""
    found = findings(ServoFaults(), tmp_path)
    assert [f.severity for f in found] == [Severity.OK, Severity.OK]
    assert found[0].seen.startswith("id 1 (belt): XL330-M077, firmware 46, 1000000 baud, operating mode 5")
    assert found[1].seen.startswith("id 2 (pole): XL330-M077")
    assert "5.0 V, 31 °C" in found[0].seen


@pytest.mark.parametrize(
    ("faults", "says", "remedy"),
    [
        (
            ServoFaults(servo_baud_rate=57600),
            "set to 57600 baud, but deal-hw expects 1000000",
            r"Baud Rate \(8\)",
        ),
        (ServoFaults(servo_baud_rate=3_000_000), "set to 3000000 baud", "baud_rate=3000000"),
        (
            ServoFaults(servo_duplicate_id=True),
            "id 1 at 1000000 baud answers pings",
            "two servos may have the same id",
        ),
        (
            ServoFaults(servo_protocol=1),
            "id 2 at 1000000 baud speaks Dynamixel protocol 1.0",
            "Protocol Type",
        ),
    ],
)
def test_doctor_tells_what_is_wrong(faults: ServoFaults, says: str, remedy: str, tmp_path: Path) -> None:
    """Servos at another rate and with one id are found, with what to do."""
    wrong = [f for f in findings(faults, tmp_path) if f.severity is Severity.FAIL]
    assert says in wrong[0].seen
    assert re.search(remedy, wrong[0].do)


def test_doctor_finds_servos_of_another_rate_on_a_port(tmp_path: Path) -> None:
    """The port itself is set to each rate in turn, and is free again at its end."""
    with emulated(ServoFaults(servo_baud_rate=57600)) as (path, _):
        found = examine_servos(path + PATIENT, MonotonicClock(), tmp_path, rates=(57600, 1_000_000))
        assert [f.seen for f in found if f.severity is Severity.FAIL] == [
            f"id {servo} is set to 57600 baud, but deal-hw expects 1000000" for servo in (1, 2)
        ]
        with SerialTransport(path):
            pass


def test_doctor_reads_the_latency_timer(tmp_path: Path) -> None:
    """16 ms is FTDI's default and worth a note; 1 ms is what it should be."""
    with emulated() as (path, _):
        timer = tmp_path / Path(path).name / "device" / "latency_timer"
        timer.parent.mkdir(parents=True)
        for value, level in ((16, Severity.NOTE), (1, Severity.OK)):
            timer.write_text(f"{value}\n")
            first = next(examine_servos(path, MonotonicClock(), tmp_path))
            assert (first.severity, first.seen) == (level, f"the adapter's latency timer is {value} ms")


def test_settings_come_with_the_port_and_from_a_file(tmp_path: Path) -> None:
    """What is in the port counts more than the file; the path is what is before the question mark."""
    file = tmp_path / "servos.json"
    file.write_text('{"cart_id": 7, "pole_zero": 100, "mode": "extended"}')
    path, settings = parse_port(f"/dev/ttyUSB0?settings={file}&cart_id=3&cart_zero=12&rail_m=0.5")
    assert path == "/dev/ttyUSB0"
    assert settings == DynamixelSettings(cart_id=3, pole_zero=100, mode="extended", cart_zero=12, rail_m=0.5)
    assert parse_port("/dev/ttyUSB0")[1] == DynamixelSettings()


@pytest.mark.parametrize(
    "port", ["/dev/x?cart_id=two", "/dev/x?nothing=1", "/dev/x?cart_id", "/dev/x?settings=/nothing.json"]
)
def test_ports_that_mean_nothing_are_refused(port: str) -> None:
    """Unknown names, wrong values and files that are not there."""
    with pytest.raises(ConfigurationError):
        parse_port(port)


def test_the_robot_is_made_by_its_transport() -> None:
    """`--transport dynamixel` gives this driver, over a port that is opened with connect."""
    robot = make_robot("cartpole", "dynamixel", "/dev/nothing?pole_id=9", MonotonicClock())
    assert isinstance(robot, DynamixelCartpole)
    assert robot.settings.pole_id == 9
    with pytest.raises(PortNotFoundError):
        robot.connect()


def test_a_child_goes_on_with_the_port() -> None:
    """A driver over an inherited descriptor finds both servos and reads states."""
    with emulated() as (path, _):
        clock = MonotonicClock()
        parent = dynamixel_robot(path + PATIENT, clock)
        parent.connect()
        child = dynamixel_robot(path + PATIENT, clock, os.dup(parent.fileno()))
        child.connect()
        assert child.read_state(5.0).sequence == 0
        child.passive()
        child.disconnect()
        parent.disconnect()
