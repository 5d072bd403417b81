"""The cart-pole on CAN: the robot contract over frames in virtual time, and a whole run over an adapter."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tty
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import can
import numpy as np
import pytest

from deal_hw.cli.collect import KINDS as COLLECT
from deal_hw.cli.collect import collect
from deal_hw.cli.emulate import KINDS as EMULATE
from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.emulator.can_emulator import can_device, can_devices, can_emulator
from deal_hw.drivers.cartpole.emulator.faults import CanFaults, Hazards
from deal_hw.drivers.cartpole.emulator.slcan_adapter import SlcanAdapter
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.can_robot import CanFrames, can_robot
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, CanLink, accept, frame_id
from deal_hw.drivers.cartpole.wire.link import SerialLink
from deal_hw.drivers.transports.slcan_transport import SlcanTransport, encode_line
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.robots.connect import claim_name, make_robot
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultRates, FaultyTransport, OneBadFrame, RecordFaults
from deal_hw.testing.pseudo_terminal import PseudoTerminal
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Message, WireOptions
from deal_hw.types import RobotState, Status
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.settings import LinkOptions

MS = 1_000_000


def fake(message: protocol.AnyMessage | None) -> CartpoleRobot:
    """Return a driver in front of a node that always says the same."""
    clock = VirtualClock()
    answer = b"" if message is None else CanLink().encode(message)
    return CartpoleRobot(VirtualTransport(FakeDevice(answer), clock), clock, link=CanLink)


def info(kind: str = "cartpole", version: int = 1) -> protocol.Info:
    """Return what a node says of itself."""
    return protocol.Info(1, kind, (2, 3, 4), 1000, 200, 1, version)


class TestCartpoleOnCan(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        clock, fault = VirtualClock(), OneBadFrame(10)
        wire = VirtualTransport(can_device(nominal_truth("ideal")), clock)
        robot = CartpoleRobot(FaultyTransport(wire, received=fault), clock, link=CanLink)

        return RobotBench(
            robot=robot,
            foreign=fake(info("toaster")),
            newer=fake(info(version=2)),
            silent=fake(None),
            unplug=wire.unplug,
            corrupt=fault.corrupt_next,
        )


def test_a_node_that_sends_but_does_not_answer_is_another_device() -> None:
    """States without an info: the message asks for the firmware's DBC."""
    state = protocol.State(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    with pytest.raises(WrongDeviceError, match="the same DBC"):
        fake(state).connect()


def test_two_devices_under_one_number_end_a_run() -> None:
    """A second serial number in a heartbeat is the robot's fault text, which the safety module trips on."""
    clock = VirtualClock()
    wire = VirtualTransport(can_device(nominal_truth("ideal")), clock)
    robot = CartpoleRobot(wire, clock, link=CanLink)
    robot.connect()
    for _ in range(20):
        robot.read_state(1.0)
    assert robot.fault == ""
    other = CanLink(unique_id=0xABC).encode(protocol.State(0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    wire._queue.append(Message("", other, clock.now_ns()))
    for _ in range(3):
        robot.read_state(1.0)
    assert "two devices use node 1" in robot.fault


@pytest.mark.parametrize(
    "message",
    [protocol.Target(9, 0, 0, 0, 0, 0), protocol.Arm(9), protocol.Home(9)],
    ids=lambda m: type(m).__name__,
)
def test_a_second_host_that_commands_the_device_ends_a_run(message: protocol.AnyMessage) -> None:
    """A program that only listens sees any host's frames; one that commands the device has no rival."""
    clock = VirtualClock()
    wire = VirtualTransport(can_device(nominal_truth("ideal")), clock)
    robot = CartpoleRobot(wire, clock, link=CanLink)
    robot.connect()
    other = Message("", CanLink().encode(message), clock.now_ns())
    wire._queue.append(other)
    robot.read_state(1.0)
    assert robot.fault == ""
    robot.home(5.0)
    robot.arm(2.0)
    assert robot.fault == ""
    wire._queue.append(other)
    for _ in range(robot._states.maxlen or 0):
        robot.read_state(1.0)
        if robot.fault:
            break
    assert "another program or computer commands node 1" in robot.fault


def test_a_host_that_stopped_has_no_rival() -> None:
    """After its own stop another program may take the device."""
    link, other = CanLink(), CanLink()
    link.encode(protocol.Arm(1))
    link.encode(protocol.Stop(2))
    list(link.decode(other.encode(protocol.Arm(3))))
    assert link.fault == ""
    link.encode(protocol.Arm(4))
    list(link.decode(other.encode(protocol.Stop(5))))
    assert link.fault == ""


def test_the_wire_changes_no_sample() -> None:
    """The same commands at the same times give the same numbers on serial frames and on CAN."""
    truth = nominal_truth("sensor", seed=3)
    runs = []
    for device, link in ((CartpoleDevice(truth), SerialLink), (can_device(truth), CanLink)):
        clock = VirtualClock()
        robot = CartpoleRobot(VirtualTransport(device, clock), clock, link=link)
        robot.connect()
        robot.home(5.0)
        robot.arm(2.0)
        found = []
        for cycle in range(100):
            clock.sleep_until_ns((2000 + 20 * cycle) * MS)
            robot.send_command(default_command(robot, 0.1 * (cycle // 10 % 2)))
            while True:
                try:
                    state = robot.read_state(0.0)
                except TransportTimeoutError:
                    break
                found.append(
                    (
                        *state.position,
                        *state.velocity,
                        state.effort[0],
                        state.device_ns,
                        state.command_sequence,
                        state.command_age_ns,
                        int(state.status),
                    )
                )
        runs.append(found)
    assert len(runs[0]) > 700
    assert runs[0] == runs[1]


# Over an emulated adapter, in a time that the test moves.


class VirtualPort(VirtualTransport):
    """A serial port in virtual time that is never lost."""

    def reopen(self) -> None:
        """It still works."""

    def fileno(self) -> int:
        """Any number: nobody waits on it."""
        return 99


class Bench:
    """An emulated adapter with a cart-pole on its bus, and the driver in front of it."""

    def __init__(self, faults: CanFaults | None = None, port: str = "slcan:x") -> None:
        faults = faults or CanFaults()
        self.clock = VirtualClock()
        adapter = SlcanAdapter(can_devices(nominal_truth(), faults), faults)
        transport = SlcanTransport(port, self.clock, accept(1), serial=VirtualPort(adapter, self.clock))
        self.robot = CartpoleRobot(CanFrames(transport), self.clock, link=CanLink)


def arm(bench: Bench) -> CartpoleRobot:
    """Return the driver, connected, homed and armed."""
    bench.robot.connect()
    bench.robot.home(5.0)
    bench.robot.arm(2.0)
    return bench.robot


def wait(robot: CartpoleRobot, wanted: Callable[[RobotState], bool]) -> RobotState:
    """Return the first state that is wanted."""
    for _ in range(2000):
        if wanted(state := robot.read_state(1.0)):
            return state
    raise AssertionError("the awaited state did not come within 2000 samples")


def command_until(bench: Bench, error: type[Exception], match: str) -> None:
    """Command and read, as the loop does, until something fails with these words."""
    robot = bench.robot
    with pytest.raises(error, match=match):
        for _ in range(500):
            robot.send_command(default_command(robot))
            try:
                for _ in range(4):
                    robot.read_state(0.02)
            except TransportTimeoutError as silence:
                if re.search(match, str(silence)):
                    raise


def test_commands_and_states_pass_the_adapter() -> None:
    """Homed, armed, commanded, passive, over lines of characters on a pty."""
    bench = Bench()
    robot = arm(bench)
    robot.send_command(default_command(robot, 0.1))
    assert wait(robot, lambda state: state.command_sequence == 0).status & Status.ARMED
    robot.passive()
    wait(robot, lambda state: Status.ARMED not in state.status)
    assert robot.transport_errors == 0


def test_bus_off_is_lost_and_passive_gets_through_once_it_is_over() -> None:
    """The adapter's bus is opened again; the device's watchdog has stopped the motor before."""
    bench = Bench(CanFaults(bus_off_after_s=0.2, bus_off_s=0.5))
    arm(bench)
    command_until(bench, TransportLostError, "bus-off")
    with pytest.raises(TransportLostError, match="bus-off"):
        bench.robot.passive()
    for _ in range(100):
        try:
            bench.robot.reopen()
            bench.robot.passive()
            state = bench.robot.read_state(0.05)
            break
        except TransportError:
            bench.clock.advance_ns(50 * MS)
    assert Status.WATCHDOG in state.status
    assert Status.ARMED not in state.status


def test_a_full_transmit_buffer_is_a_timeout_and_passes() -> None:
    """Afterwards the same connection goes on."""
    bench = Bench(CanFaults(tx_full_after_s=0.2, tx_full_s=0.1))
    arm(bench)
    command_until(bench, TransportTimeoutError, "transmit buffer is full")
    bench.clock.advance_ns(500 * MS)
    bench.robot.passive()
    wait(bench.robot, lambda state: Status.ARMED not in state.status)


def test_a_lost_node_is_silence_that_names_the_reason() -> None:
    """The adapter stays; it says that nobody acknowledges."""
    bench = Bench(CanFaults(lost_node_after_s=0.2))
    arm(bench)
    command_until(bench, TransportTimeoutError, "acknowledges")


def test_a_bus_without_another_node_is_refused_with_its_reason() -> None:
    """Power, bit rate, termination."""
    with pytest.raises(TransportTimeoutError, match=r"no answer to hello.*termination"):
        Bench(CanFaults(no_acknowledge=True)).robot.connect()


def test_a_wrong_bit_rate_drives_the_bus_off() -> None:
    """A host at 500 kbit/s on a bus at 1 Mbit/s."""
    with pytest.raises(TransportLostError, match=r"bus-off.*500000 bit/s.*slcan:x\?bitrate=RATE") as caught:
        Bench(CanFaults(bitrate=1_000_000), port="slcan:x?bitrate=500000").robot.connect()
    # `ip link` sets SocketCAN's bit rate, not that of a serial adapter.
    assert "ip link" not in str(caught.value)
    assert "SocketCAN" not in str(caught.value)


def test_two_nodes_under_one_number_are_refused() -> None:
    """Their answers tear each other; their heartbeats tell them apart."""
    with pytest.raises(WrongDeviceError, match="two devices use node 1"):
        Bench(CanFaults(duplicate_node=True)).robot.connect()


def test_a_dbc_of_another_version_is_refused() -> None:
    """The message says which side is to be updated."""
    with pytest.raises(VersionMismatchError, match="update deal-hw"):
        Bench(CanFaults(dbc_version=2)).robot.connect()


def test_another_node_number_is_silence() -> None:
    """Frames of node 7 are foreign to node 1; the port that the emulator prints has the number."""
    faults = CanFaults(node=7)
    with pytest.raises(TransportTimeoutError, match="no answer"):
        Bench(faults).robot.connect()
    emulator = can_emulator(nominal_truth(), link=None, hazards=Hazards(can=faults))
    assert emulator.open().endswith("?node=7")
    emulator.close()


def test_five_percent_of_corrupt_and_lost_lines_are_survived() -> None:
    """Both ways: requests are repeated, samples that suffered are refused whole, positions stay true."""
    rates = FaultRates(corrupt=0.05, drop=0.02, duplicate=0.02)
    clock = VirtualClock()
    wire = VirtualTransport(can_device(nominal_truth()), clock)
    faults = [RecordFaults(rates, np.random.default_rng(seed), size=FRAME.size, header=8) for seed in (1, 2)]
    robot = CartpoleRobot(FaultyTransport(wire, faults[0], faults[1]), clock, link=CanLink)
    robot.connect()
    robot.home(5.0)
    robot.arm(2.0)
    sequences = []
    for k in range(300):
        robot.send_command(default_command(robot, 0.05 * (k % 2)))
        for _ in range(2):
            state = robot.read_state(0.5)
            sequences.append(state.sequence)
            assert abs(state.position[0]) < 0.41
            assert abs(state.position[1]) < 10
    assert sequences == sorted(set(sequences))
    assert robot.transport_errors > 50


# Plumbing.


def test_an_adapter_answers_what_other_programs_ask() -> None:
    """Version, serial number and unknown commands, as Lawicel's manual has them."""
    adapter = SlcanAdapter([can_device(nominal_truth("ideal"))], CanFaults())
    adapter.receive(b"V\rN\rX\rt1230\r")
    assert adapter.advance_to(0) == b"V1013\rNEMUL\r\a\a"
    adapter.receive(b"S6\rO\rt1230\rF\r")
    assert adapter.advance_to(0) == b"\r\rz\rF00\r"


@pytest.mark.real_time
def test_python_can_reads_the_emulated_bus() -> None:
    """Another program's slcan client finds states of node 1."""
    clock = VirtualClock()
    adapter = SlcanAdapter([can_device(nominal_truth("ideal"))], CanFaults())
    emulator = PseudoTerminal(adapter, clock=clock)
    bus = can.Bus(
        interface="slcan", channel=emulator.open(), bitrate=500_000, sleep_after_open=0, ignore_config=True
    )
    found = set()
    for _ in range(40):
        clock.advance_ns(5 * MS)
        emulator.step(0.0)
        while (frame := bus.recv(0.01)) is not None:
            found.add(frame.arbitration_id)
    bus.shutdown()
    emulator.close()
    assert found >= {0x28, 0x29, 0x2A, 0x2B, 0x2C, 0x2D}


def test_settings_of_a_network_are_refused() -> None:
    """As on a serial port."""
    with pytest.raises(ConfigurationError, match="--domain"):
        make_robot("cartpole", "can", "can0", MonotonicClock(), WireOptions(domain=3))


def test_a_listening_run_cannot_send(tmp_path: Path) -> None:
    """A dry run's robot has no way to send."""
    master, slave = os.openpty()
    tty.setraw(slave)
    robot = can_robot(os.ttyname(slave), MonotonicClock(), can_send=False)
    with pytest.raises(SafetyError, match="only listens"):
        robot.passive()
    for fd in (master, slave):
        os.close(fd)


def test_settings_of_a_port_do_not_make_it_another_robot(tmp_path: Path) -> None:
    """Two commanders on one adapter claim the same thing, through a link as well."""
    (tmp_path / "link").symlink_to("/dev/null")
    claims = {
        claim_name("can", port, WireOptions())
        for port in ("slcan:/dev/null", "slcan:/dev/null?node=3", f"slcan:{tmp_path}/link")
    }
    assert claims == {"can on slcan:/dev/null"}


@pytest.mark.parametrize("transport", ["can", "odrive"])
@pytest.mark.parametrize(
    ("short", "whole"),
    [("can0", "socketcan:can0"), ("/dev/null", "slcan:/dev/null"), ("can0?node=3", "can0")],
)
def test_two_ways_to_write_a_port_are_one_robot(transport: str, short: str, whole: str) -> None:
    """Otherwise two programs could command it at once."""
    assert claim_name(transport, short, WireOptions()) == claim_name(transport, whole, WireOptions())


def test_options_of_a_bus_need_one() -> None:
    """On the serial wire they would be ignored."""
    with pytest.raises(ConfigurationError, match="--node would have no effect"):
        EMULATE.settings(robot="cartpole", can=CanFaults(node=3))
    EMULATE.settings(robot="cartpole", transport="can", can=CanFaults(node=3))


@pytest.mark.real_time
@pytest.mark.parametrize("transport", ["can", "odrive"])
def test_collect_records_a_whole_run(tmp_path: Path, transport: str) -> None:
    """Two processes, an inherited adapter, the emulator as a third: every state is there, none torn."""
    with EmulatorProcess("cartpole", "--transport", transport, "--profile", "ideal", "--nominal") as emulator:
        report = collect(
            COLLECT.settings(
                robot="cartpole",
                port=emulator.port,
                link=LinkOptions(transport=transport),
                out=tmp_path / "run",
                motion="hold",
                seconds=1.0,
                quiet=True,
            )
        )
    assert [episode.outcome.value for episode in report.episodes] == ["finished"]
    trajectory = Dataset.open(tmp_path / "run" / "dataset").read(0).trajectory
    assert trajectory.position.shape[0] >= 180
    assert np.isfinite(trajectory.position).all()


@pytest.mark.real_time
def test_python_can_logs_the_bus_and_cantools_decodes_it(tmp_path: Path) -> None:
    """Other people's programs at the emulator's port: python-can's slcan and logger, cantools' `decode`."""
    log = tmp_path / "candump.log"
    with (
        EmulatorProcess("cartpole", "--transport", "can", "--profile", "ideal", "--nominal") as emulator,
        can.Bus(
            interface="slcan",
            channel=emulator.port.removeprefix("slcan:"),
            bitrate=500_000,
            ignore_config=True,
        ) as bus,
        can.Logger(log) as logger,
    ):
        for _ in range(400):
            frame = bus.recv(5.0)
            assert frame is not None
            logger.on_message_received(frame)
    dbc = resources.files("deal_hw.drivers.cartpole") / "assets" / "cartpole.dbc"
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
    decoded = subprocess.run(
        command, input=log.read_text(), capture_output=True, text=True, check=True
    ).stdout
    lines = decoded.splitlines()
    assert len(lines) == 400 and all(" :: " in line for line in lines)
    numbers = [int(line.split("Sequence: ")[1].split(",")[0]) for line in lines if ":: State1(" in line]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))) and len(numbers) > 70
    assert any(":: Heartbeat(" in line for line in lines)


def test_only_frames_on_the_bus_have_reached_the_device() -> None:
    """A dry run opens the adapter, and the device has received nothing; then one frame of 16 bytes."""
    adapter = SlcanAdapter([can_device(nominal_truth())], CanFaults())
    adapter.receive(b"\rC\rS6\rO\r")
    assert adapter.received_bytes == 0
    adapter.receive(encode_line(f"{frame_id('Stop', 1):X}", b"\1\0\0\0"))
    assert adapter.received_bytes == FRAME.size == 16
