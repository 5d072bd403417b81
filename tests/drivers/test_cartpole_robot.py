"""The cart-pole's driver over a virtual wire: the robot contract, and what is particular to this device."""

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.drivers.cartpole.chips.device import CartpoleDevice
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.robot import CartpoleRobot
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.protocol import DELIMITER, Info
from deal_hw.drivers.command_echo import NumberWatch
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import SafetyError, TransportTimeoutError, WrongDeviceError
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command, run_cycles
from deal_hw.transport import Message, Transport
from deal_hw.types import Status


def fake(answer: bytes) -> CartpoleRobot:
    """Return a driver in front of a device that always says the same."""
    clock = VirtualClock()
    return CartpoleRobot(VirtualTransport(FakeDevice(answer), clock), clock)


def info(kind: str = "cartpole", version: int = 1) -> bytes:
    """Return an info frame."""
    return protocol.encode(Info(1, kind, (2, 3, 4), 1000, 200, 1, version))


class Wire:
    """A nominal device, its driver, and everything between them."""

    def __init__(self, wrap: Callable[[Transport], Transport] = lambda t: t, profile: str = "ideal") -> None:
        self.clock = VirtualClock()
        self.device = CartpoleDevice(nominal_truth(profile))
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot = CartpoleRobot(wrap(self.virtual), self.clock)

    def armed(self) -> CartpoleRobot:
        """Return the driver, connected, homed and armed."""
        self.robot.connect()
        self.robot.home(2.0)
        self.robot.arm(1.0)
        return self.robot


class TestCartpoleRobot(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadFrame(10)
        wire = Wire(lambda transport: FaultyTransport(transport, received=fault))

        return RobotBench(
            robot=wire.robot,
            foreign=fake(info("toaster")),
            newer=fake(info(version=2)),
            silent=fake(b""),
            unplug=wire.virtual.unplug,
            corrupt=fault.corrupt_next,
        )


def test_bytes_that_are_no_frames_are_another_device() -> None:
    """A talkative device that is no cart-pole raises WrongDeviceError and names the baud rate."""
    with pytest.raises(WrongDeviceError, match="1000000"):
        fake(b"GRBL 1.1 ['$' for help]\r\n").connect()


def test_an_older_device_is_told_from_a_newer_one() -> None:
    """The message says which side is to be updated, and the device's firmware."""
    with pytest.raises(Exception, match=r"firmware 2\.3\.4.*version 0.*update the device's firmware"):
        fake(info(version=0)).connect()
    with pytest.raises(Exception, match="update deal-hw"):
        fake(info(version=2)).connect()


def test_a_failed_connect_closes_the_port() -> None:
    """After an error the transport is closed, so that another attempt starts afresh."""
    wire = Wire()
    robot = fake(b"")
    for _ in range(2):
        with pytest.raises(TransportTimeoutError):
            robot.connect()
    wire.robot.connect()
    assert wire.robot.info is not None
    assert wire.robot.info.kind == "cartpole"


def test_arming_before_homing_says_what_to_do() -> None:
    """The device's refusal becomes an error that names the remedy."""
    wire = Wire()
    wire.robot.connect()
    with pytest.raises(SafetyError, match="home"):
        wire.robot.arm(1.0)


def test_the_watchdog_is_seen_and_cleared_by_arming() -> None:
    """300 ms of silence latch it; arm clears it."""
    wire = Wire()
    robot = wire.armed()
    robot.send_command(default_command(robot))
    wire.clock.advance_ns(300_000_000)
    statuses = []
    while True:
        try:
            statuses.append(robot.read_state(0.0).status)
        except TransportTimeoutError:
            break
    assert statuses[-1] == Status.HOMED | Status.WATCHDOG
    robot.arm(1.0)
    assert robot.read_state(0.1).status == Status.HOMED | Status.ARMED


def test_what_the_wire_does_not_carry_returns_as_zero() -> None:
    """Velocity target and feed-forward effort return as 0; too large a limit is clipped to its field."""
    robot = Wire().armed()
    command = default_command(robot, 0.1)
    command.velocity_target[:] = 1.0
    command.effort[:] = 1.0
    command.effort_limit[:] = 100.0
    sent = robot.send_command(command)
    assert (sent.velocity_target[0], sent.effort[0], sent.effort_limit[0]) == (0.0, 0.0, 65.535)
    assert (sent.position_target[0], sent.stiffness[0], sent.speed_limit[0]) == (0.1, 80.0, 1.0)


def test_five_percent_of_corrupt_frames_in_both_directions_are_survived() -> None:
    """Requests get through by repetition, errors are counted, states stay true and in order."""
    faults = [FrameFaults(FaultRates(corrupt=0.05), np.random.default_rng(seed)) for seed in (1, 2)]
    wire = Wire(lambda transport: FaultyTransport(transport, received=faults[0], sent=faults[1]))
    robot = wire.armed()
    before = robot.transport_errors
    sequences = []
    for i in range(500):
        robot.send_command(default_command(robot, 0.05 * (i % 2)))
        for _ in range(4):
            state = robot.read_state(0.5)
            sequences.append(state.sequence)
            assert abs(state.position[0]) < 0.41
    assert sequences == sorted(set(sequences))
    # Each corrupt frame counts as corrupt and as a gap in the sequence.
    assert 100 < robot.transport_errors - before < 300
    assert wire.device.frame_errors > 5
    assert robot.resent <= 5


def test_lost_and_repeated_frames_are_survived() -> None:
    """20 % lost and 20 % repeated: requests are repeated, and a duplicate command does not act twice."""
    rates = FaultRates(drop=0.2, duplicate=0.2)
    faults = [FrameFaults(rates, np.random.default_rng(seed)) for seed in (5, 6)]
    wire = Wire(lambda transport: FaultyTransport(transport, received=faults[0], sent=faults[1]))
    robot = wire.armed()
    for _ in range(50):
        robot.send_command(default_command(robot))
        robot.read_state(0.5)
    assert faults[0].dropped > 5 < faults[0].duplicated


@pytest.mark.parametrize("number", [0, 7, 4_000_000])
def test_another_programs_target_is_a_fault(number: int) -> None:
    """Its number is none that this run has sent since the one before: known by the second state with it."""
    wire = Wire()
    robot = wire.armed()
    run_cycles(robot, wire.clock, 20, default_command(robot))
    target = protocol.Target(number, 100_000, 1000, 100, 5000, 500_000)
    wire.device.receive(protocol.encode(target))
    seen: list[int] = []
    while not robot.fault:
        seen.append(robot.read_state(0.02).command_sequence)
    assert robot.fault.startswith(f"another program commands the cart-pole: it follows command {number}, ")
    assert seen.count(number) == 2
    robot.passive()
    robot.arm(1.0)
    assert robot.fault == ""


def test_one_corrupt_number_is_no_other_program() -> None:
    """A check of 16 bits passes one in some ten thousand corrupt frames."""
    watch = NumberWatch()
    watch.shown(9)
    for number in range(20):
        watch.sent(number)
        watch.shown(number if number != 10 else 3_000_000)
        assert watch.foreign == -1
    watch.shown(3)
    assert watch.foreign == 3


def test_a_torn_write_does_not_swallow_the_next_frame() -> None:
    """After a write that was cut short, the next command arrives all the same."""

    class Torn(FaultyTransport):
        tear = False

        def send(self, message: Message) -> None:
            if self.tear:
                self.tear = False
                super().send(Message("", message.payload[:9], message.stamp_ns))
                raise TransportTimeoutError("took 9 bytes")
            super().send(message)

    wire = Wire(Torn)
    robot = wire.armed()
    transport = robot._transport
    assert isinstance(transport, Torn)
    transport.tear = True
    with pytest.raises(TransportTimeoutError):
        robot.send_command(default_command(robot))
    robot.send_command(default_command(robot))
    while robot.read_state(0.1).command_sequence != 0:
        assert wire.clock.now_ns() < 2_000_000_000
    assert wire.device.frame_errors == 1


def test_passive_begins_with_a_delimiter() -> None:
    """The process that used the port before may have died in the middle of a frame."""
    wire = Wire()
    robot = wire.armed()
    robot.take_wire()
    robot.passive()
    (message,) = [m for m in robot.take_wire() if m.channel == "tx"]
    assert message.payload.startswith(DELIMITER)


def test_old_states_do_not_pass_for_a_confirmation_of_passive() -> None:
    """States that waited from before arming are gone after passive; the first one read was sent after it."""
    wire = Wire()
    robot = wire.armed()
    before_ns = wire.clock.now_ns()
    robot.passive()
    assert robot.read_state(0.1).receive_ns > before_ns


def test_a_wire_that_loses_everything_is_a_timeout() -> None:
    """All frames lost: connecting gives up after its time, although the device talks on."""
    lost = FrameFaults(FaultRates(drop=1.0), np.random.default_rng(0))
    clock = VirtualClock()
    virtual = VirtualTransport(CartpoleDevice(nominal_truth()), clock)
    robot = CartpoleRobot(FaultyTransport(virtual, received=lost, clock=clock), clock)
    with pytest.raises(TransportTimeoutError, match="no answer to hello within 1 s"):
        robot.connect()
    assert 1_000_000_000 <= clock.now_ns() < 1_200_000_000


def test_a_second_process_on_the_same_wire_starts_passive() -> None:
    """A driver that connects anew, as a child does, finds the motor off and counts from 0."""
    wire = Wire()
    first = wire.armed()
    first.send_command(default_command(first))
    second = CartpoleRobot(wire.virtual, wire.clock)
    second.connect()
    state = second.read_state(0.1)
    assert not state.status & Status.ARMED
    assert (state.command_sequence, second.last_sequence) == (-1, -1)


def test_a_device_that_restarted_is_one_error() -> None:
    """A state number that goes back counts once, not as four thousand million lost samples."""
    states = [
        protocol.encode(protocol.State(n, n * 5000, 0, 0, 0, 0, 0, 0, protocol.NO_COMMAND, 0))
        for n in (100, 0, 1)
    ]
    robot = fake(info() + b"".join(states))
    robot.connect()
    assert [robot.read_state(0.1).sequence for _ in range(3)] == [100, 0, 1]
    assert robot.transport_errors == 1
