"""The cart-pole on two Dynamixel servos: the robot contract on the emulated bus, and what is its own."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

import numpy as np
import pytest
from dynamixel_rig import Wire, middle

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.cartpole.dynamixel.device import OVERLOAD
from deal_hw.drivers.cartpole.dynamixel.settings import DynamixelSettings
from deal_hw.drivers.cartpole.wire.protocol import Target
from deal_hw.drivers.servo_bus.emulated_servo import EmulatedServo
from deal_hw.drivers.servo_bus.registers import (
    DRIVE_MODE,
    ID,
    MODEL_NUMBER,
    OPERATING_MODE,
    PRESENT_POSITION,
    STATUS_RETURN_LEVEL,
    TORQUE_ENABLE,
    Register,
)
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
    TransportTimeoutError,
    WrongDeviceError,
)
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults, OneBadFrame
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Message, Transport
from deal_hw.types import Status


class TestDynamixelCartpole(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadFrame(20)
        wire = Wire(lambda t: FaultyTransport(t, received=fault))
        foreign, newer, silent = Wire(), Wire(), Wire()
        foreign.cart.put(MODEL_NUMBER, 350)
        newer.pole.protocol = 1
        for servo in silent.device.servos:
            servo.present = False

        return RobotBench(
            robot=wire.robot,
            foreign=foreign.robot,
            newer=newer.robot,
            silent=silent.robot,
            unplug=wire.virtual.unplug,
            corrupt=fault.corrupt_next,
        )


def test_homing_finds_the_middle_between_the_stops() -> None:
    """The motor finds both ends, the cart ends in the middle, the hand sets the pole, no torque is left."""
    wire = Wire(cart_zero=None)
    wire.robot.connect()
    wire.robot.home(20.0)
    cart, pole = wire.device.true_position
    assert abs(cart) < 0.004
    assert abs(pole) < 0.04
    state = wire.robot.read_state(0.1)
    np.testing.assert_allclose(state.position, [cart, pole], atol=2e-3)
    assert state.status == Status.HOMED


def test_a_known_middle_needs_no_stops() -> None:
    """With cart_zero homing takes as long as the hand, and the turn of the belt servo does not matter."""
    wire = Wire(cart_zero=middle() + 3 * 4096)
    wire.robot.connect()
    start_ns = wire.clock.now_ns()
    wire.robot.home(5.0)
    assert wire.clock.now_ns() - start_ns < 3_000_000_000
    assert abs(wire.device.true_position[0]) < 0.004


@pytest.mark.parametrize("direction", [1, -1])
def test_both_directions_of_mounting(direction: int) -> None:
    """A servo that is mounted the other way round moves the cart, and reads the pole, to the same side."""
    wire = Wire(cart_zero=None, cart_direction=direction, pole_direction=direction, pole_zero=100)
    wire.armed()
    states = wire.run(10, target=0.05)
    cart, pole = wire.device.true_position
    assert cart > 0.01
    # The cart goes to the right, so the pole falls to the left.
    assert pole < -0.03
    np.testing.assert_allclose(states[-1].position, [cart, pole], atol=0.02)
    assert max(state.effort[0] for state in states) > 1.0


def test_a_rail_of_another_length_is_refused() -> None:
    """Homing that finds another way than the settings say is no homing."""
    wire = Wire(cart_zero=None, rail_m=0.9)
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"0\.80\d m between the end stops, but the settings have 0\.9"):
        wire.robot.home(20.0)
    assert not wire.cart.get(TORQUE_ENABLE)
    with pytest.raises(SafetyError, match="home"):
        wire.robot.arm(1.0)


def test_a_pole_that_nobody_sets_ends_homing() -> None:
    """Upright somewhere else: the message says how the pole stands and what to do; the LED goes dark."""
    wire = Wire(device=DynamixelSettings(), pole_zero=1024)
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match=r"pole is at .* rad.*LED of servo 2.*pole_zero"):
        wire.robot.home(10.0)
    wire.clock.advance_ns(10_000_000)
    wire.robot.read_state(0.1)
    assert (wire.cart.get(TORQUE_ENABLE), wire.pole.block.led) == (0, 0)


def test_states_stand_on_a_regular_grid() -> None:
    """Samples of a running loop are 5 ms apart on the servo's clock, 4 a cycle; commands never collide."""
    wire = Wire()
    wire.armed()
    states = wire.run(50)
    periods = np.diff([state.device_ns for state in states[1:]])
    assert set(periods) == {5_000_000}
    assert len(states) in (200, 201)
    assert wire.robot.transport_errors == 0


def test_gains_and_limits_go_out_when_they_change_only() -> None:
    """The first command writes gains, effort limit and goal; the next one the goal alone."""
    wire = Wire()
    robot = wire.armed()
    robot.take_wire()
    robot.send_command(default_command(robot, 0.02))
    (message,) = [m for m in robot.take_wire() if m.channel == "tx"]
    # Header 4, id, length 2, instruction, address 2, size 2, id, 12 bytes from 108 on, CRC 2; then 15 bytes
    # that ask for the servo's clock.
    assert len(message.payload) == 27 + 15
    block = wire.cart.block
    # 80 N/m / 1.148; 8 N·s/m / 0.00918; 4 N / 0.00574; 1 m/s / (0.229 / 60 * 0.16).
    assert (block.p_gain, block.d_gain, block.goal_current, block.profile_velocity) == (70, 871, 697, 1638)
    assert block.i_gain == 0
    assert block.bus_watchdog == 10


def test_no_speed_limit_is_never_sent_for_a_slow_one() -> None:
    """A profile velocity of 0 means none: the slowest limit is 1."""
    robot = Wire().armed()
    command = default_command(robot)
    command.speed_limit[:] = 0.0
    assert robot.send_command(command).speed_limit[0] == pytest.approx(0.229 / 60 * 0.16)


def test_an_effort_beyond_the_servo_is_clipped_to_its_limit() -> None:
    """The servo would refuse the write, silently: sync writes are not answered."""
    wire = Wire()
    robot = wire.armed()
    command = default_command(robot)
    command.effort_limit[:] = 100.0
    sent = robot.send_command(command)
    assert sent.effort_limit[0] == pytest.approx(1750 * 0.00574)
    robot.read_state(0.1)
    assert wire.cart.block.goal_current == 1750


def test_a_lost_command_is_counted_and_all_of_the_next_is_sent() -> None:
    """A sync write that got lost shows with the next sample: the servo still has the goal before.

    The question for the servo's clock, in the same message, counts too: its answer stays away.
    """

    class Deaf(FaultyTransport):
        deaf = False

        def send(self, message: Message) -> None:
            if not self.deaf:
                self._inner.send(message)
            self.deaf = False

    wire = Wire(lambda t: Deaf(t, received=None))
    robot = wire.armed()
    wire.run(1)
    transport = robot._transport
    assert isinstance(transport, Deaf)
    transport.deaf = True
    before, errors = robot.last_sequence, robot.transport_errors
    states = wire.run(1, target=0.03)
    assert {state.command_sequence for state in states[-3:]} == {before}
    assert robot.transport_errors == errors + 2
    states = wire.run(1, target=0.04)
    assert states[-1].command_sequence == before + 2


def test_states_say_when_the_servo_got_a_command_however_late_this_computer_was() -> None:
    """Its scheduler holds messages back: reception is by the servo's clock, to the control period.

    Taken from this computer's times it was off by 1.2 ms, and a calibration found masses and gains that move
    the cart as much.
    """

    class Late(FaultyTransport):
        rng = np.random.default_rng(1)

        def send(self, message: Message) -> None:
            wire.clock.advance_ns(int(self.rng.integers(0, 1_500_000)))
            self._inner.send(message)

    wire = Wire(lambda t: Late(t, received=None))
    wire.armed()
    accepted: list[int] = []
    accept = wire.device._belt._loop.accept

    def note(target: Target) -> None:
        accepted.append(wire.device._tick)
        accept(target)

    wire.device._belt._loop.accept = note  # type: ignore[method-assign]
    states = [state for k in range(1, 51) for state in wire.run(1, target=0.001 * k)]
    reported = {s.command_sequence: s.device_ns - s.command_age_ns for s in states if s.command_sequence > 0}
    assert all(s.command_age_ns >= 0 for s in states if s.command_sequence > 0)
    assert set(reported) >= set(range(1, 50))
    offsets = {accepted[sequence] - math.ceil(received / 1e6) for sequence, received in reported.items()}
    assert len(offsets) == 1


def test_a_silent_host_is_stopped_by_the_servo() -> None:
    """0.2 s without a packet: the belt servo's watchdog stops it, states say so, arming clears it."""
    wire = Wire()
    robot = wire.armed()
    wire.run(5)
    wire.clock.advance_ns(300_000_000)
    with pytest.raises(TransportTimeoutError):
        wire.virtual.receive(0.0)
    assert (wire.device.watchdog, wire.device.mode) == (True, "stopped")
    # Asked again, the driver finds its own watchdog due, too, and switches the torque off.
    assert Status.WATCHDOG in robot.read_state(0.1).status
    robot.passive()
    assert robot.read_state(0.1).status & (Status.ARMED | Status.WATCHDOG) == Status.WATCHDOG
    robot.arm(1.0)
    assert robot.read_state(0.1).status == Status.HOMED | Status.ARMED


def test_who_only_reads_states_does_not_keep_the_motor_going() -> None:
    """Our questions keep the servo's watchdog quiet, so the driver itself ends a motion without commands."""
    wire = Wire()
    robot = wire.armed()
    wire.run(2)
    start_ns = wire.clock.now_ns()
    while Status.ARMED in (state := robot.read_state(0.1)).status:
        assert wire.clock.now_ns() - start_ns < 300_000_000
    assert Status.WATCHDOG in state.status
    assert not wire.cart.get(TORQUE_ENABLE)


@pytest.mark.parametrize("servo", [0, 1])
def test_a_servo_that_restarts_is_not_driven_on(servo: int) -> None:
    """Its clock jumps back: a fault that names it, no torque, and homing anew before the next arming."""
    wire = Wire()
    robot = wire.armed()
    wire.run(5)
    wire.device.reboot(wire.device.servos[servo])
    wire.clock.advance_ns(400_000_000)
    while not robot.fault:
        robot.read_state(0.1)
    assert f"servo {servo + 1} restarted" in robot.fault
    state = robot.read_state(0.1)
    assert Status.FAULT in state.status
    assert Status.HOMED not in state.status
    robot.passive()
    with pytest.raises(SafetyError, match="home"):
        robot.arm(1.0)
    robot.home(20.0)
    robot.arm(1.0)
    assert robot.fault == ""


def test_an_overload_is_named_with_its_remedy() -> None:
    """The servo switches its torque off and says why; it is not armed again before it was switched off."""
    wire = Wire()
    robot = wire.armed()
    wire.run(3)
    wire.cart.fail(OVERLOAD)
    states = wire.run(1)
    assert Status.ARMED not in states[-1].status
    assert Status.FAULT in states[-1].status
    assert "servo 1 reports: overload (look for a jam or too high a load" in robot.fault
    robot.passive()
    with pytest.raises(SafetyError, match="overload"):
        robot.home(20.0)
    wire.device.reboot(wire.cart)
    wire.clock.advance_ns(400_000_000)
    robot.home(20.0)


def test_an_absent_servo_costs_less_than_a_cycle() -> None:
    """No call takes longer than asked, each unanswered question 4.9 ms; in 80 ms the absent one is named."""
    wire = Wire()
    robot = wire.armed()
    wire.run(5)
    wire.pole.present = False
    start_ns = wire.clock.now_ns()
    while not robot.fault:
        wire.run(1)
        assert (wire.clock.now_ns() - start_ns) % 20_000_000 == 0
    assert wire.clock.now_ns() - start_ns <= 80_000_000
    assert "servo 2 (pole) stopped answering" in robot.fault
    assert make_passive(robot, wire.clock)
    assert not wire.cart.get(TORQUE_ENABLE)
    assert np.isnan(robot.read_state(0.1).position[1])


def test_five_percent_of_corrupt_packets_in_both_directions_are_survived() -> None:
    """Homing, arming and a run go through; states stay true and in order, no fault is seen."""
    faults = [FrameFaults(FaultRates(corrupt=0.05), np.random.default_rng(seed), None) for seed in (1, 2)]
    wire = Wire(lambda t: FaultyTransport(t, received=faults[0], sent=faults[1]))
    robot = wire.armed()
    states = wire.run(200, target=0.02)
    numbers = [state.sequence for state in states]
    assert numbers == sorted(set(numbers))
    assert robot.fault == ""
    assert all(abs(state.position[0]) < 0.41 for state in states)
    assert 50 < robot.transport_errors < 200
    assert wire.device.frame_errors > 20


def test_servos_that_know_no_fast_read_are_asked_one_after_the_other() -> None:
    """An older firmware ignores Fast Sync Read: Sync Read gives the same states."""
    wire = Wire()
    wire.device.bus.fast_read = False
    robot = wire.armed()
    assert robot.info is not None
    assert not robot.info.fast_sync_read
    states = wire.run(10)
    assert len(states) >= 39
    assert robot.transport_errors == 0


@pytest.mark.parametrize(
    ("servo", "register", "value", "says"),
    [
        (0, OPERATING_MODE, 3, r"servo 1 has 3 in its register Operating Mode \(11\); set it to 5"),
        (0, DRIVE_MODE, 4, r"Drive Mode \(10\); set it to 0"),
        (1, STATUS_RETURN_LEVEL, 1, r"servo 2 has 1 in its register Status Return Level \(68\); set it to 2"),
    ],
)
def test_a_servo_that_is_set_up_otherwise_is_refused(
    servo: int, register: Register, value: int, says: str
) -> None:
    """The message names servo, register, value and remedy."""
    wire = Wire()
    wire.device.servos[servo].put(register, value)
    with pytest.raises(ConfigurationError, match=says):
        wire.robot.connect()


def test_a_servo_without_current_control_needs_the_other_mode() -> None:
    """An XL430 is refused with the setting that makes it work; with that setting it is driven."""
    wire = Wire()
    wire.cart.put(MODEL_NUMBER, 1060)
    with pytest.raises(WrongDeviceError, match=r'XL430-W250.*mode="extended"'):
        wire.robot.connect()
    wire = Wire(mode="extended")
    wire.cart.put(MODEL_NUMBER, 1060)
    wire.armed()
    wire.run(10, target=0.05)
    # 4 N / 0.00954 N.
    assert wire.cart.block.goal_pwm == 419
    assert wire.device.true_position[0] > 0.01


class Deaf(Transport):
    """A wire that swallows requests.

    Args:
        inner: The wire.
        swallows: Says of each request whether it is lost.
    """

    def __init__(self, inner: Transport, swallows: Callable[[bytes], bool]) -> None:
        self.inner, self.swallows = inner, swallows

    def open(self) -> None:
        """Open the wire."""
        self.inner.open()

    def close(self) -> None:
        """Close the wire."""
        self.inner.close()

    def send(self, message: Message) -> None:
        """Pass a request on, or lose it."""
        if not self.swallows(message.payload):
            self.inner.send(message)

    def receive(self, timeout_s: float) -> Message:
        """Return the next bytes."""
        return self.inner.receive(timeout_s)


def test_servos_that_answer_after_a_pause_are_found() -> None:
    """The computer pauses for ten pings, some 40 ms; then both answer the request to all, and their own."""
    left = [10]

    def swallows(request: bytes) -> bool:
        left[0] -= 1
        return left[0] >= 0

    wire = Wire(lambda inner: Deaf(inner, swallows))
    wire.robot.connect()
    assert wire.robot.info is not None
    assert (wire.robot.info.cart.id, wire.robot.info.pole.id) == (1, 2)


def test_servos_that_only_answer_a_request_to_all_are_not_called_absent() -> None:
    """Lost: every ping to one servo. The message counts the tries; it said "does not answer; these do"."""
    wire = Wire(lambda inner: Deaf(inner, lambda request: request[4] != 0xFE and request[7] == 1))
    with pytest.raises(TransportTimeoutError) as caught:
        wire.robot.connect()
    printed = str(caught.value)
    assert "servos 1 and 2 answered a request to all servos, but none of 10 requests" in printed
    assert "(20 without an answer within 3 ms, 0 corrupt)" in printed
    assert "answer_s" in printed
    assert "does not answer" not in printed


def test_two_servos_with_one_id_are_told() -> None:
    """Factory-new servos all have id 1: the message says who answers and how to separate them."""
    wire = Wire()
    wire.pole.put(ID, 1)
    with pytest.raises(
        TransportTimeoutError, match=r"servo 2 does not answer; these do: 1 .*connect one alone"
    ):
        wire.robot.connect()
    wire = Wire()
    third = EmulatedServo(1, 1_000_000)
    third.put(PRESENT_POSITION, 1234)
    wire.device.servos.append(third)
    third.put(STATUS_RETURN_LEVEL, 1)
    with pytest.raises(WrongDeviceError, match="answers of servo 1 are corrupt at every attempt"):
        wire.robot.connect()


def test_another_baud_rate_is_silence_with_advice() -> None:
    """Servos of another rate do not answer; doctor looks at every rate."""
    wire = Wire()
    wire.device.bus.host_baud_rate = 57600
    with pytest.raises(TransportTimeoutError, match=r"New servos use 57600 baud.*doctor"):
        wire.robot.connect()


def test_noise_is_another_device() -> None:
    """Bytes that are no packets raise WrongDeviceError, which names the three usual reasons."""

    class Chatter(FaultyTransport):
        def receive(self, timeout_s: float) -> Message:
            with contextlib.suppress(TransportTimeoutError):
                self._inner.receive(timeout_s)
            return Message("", b"GRBL 1.1\r\n", 0) if timeout_s > 0 else self._inner.receive(0.0)

    with pytest.raises(WrongDeviceError, match="another device on this port"):
        Wire(lambda t: Chatter(t)).robot.connect()


def test_a_bus_that_is_too_slow_is_refused_before_anything_is_sent() -> None:
    """At 57600 baud one sample takes 30.6 ms of 5: 176 bytes of 10 bits."""
    with pytest.raises(ConfigurationError, match=r"takes 30\.6 ms of the 5 ms"):
        Wire(baud_rate=57600).robot.connect()


def test_a_dry_run_cannot_listen() -> None:
    """Servos are silent unless asked, and a dry run sends nothing."""
    wire = Wire(listen_only)
    with pytest.raises(ConfigurationError, match="dry run"):
        wire.robot.connect()


def test_passive_drops_an_answer_that_is_under_way() -> None:
    """What was asked before the torque went off must not pass for a confirmation."""
    wire = Wire()
    robot = wire.armed()
    wire.run(2)
    with pytest.raises(TransportTimeoutError):
        while True:
            robot.read_state(0.0025)
    robot.passive()
    assert Status.ARMED not in robot.read_state(0.1).status


def test_settings_that_mean_nothing_are_refused() -> None:
    """Each names the field and what is allowed."""
    for values, says in (
        ({"cart_id": 2}, "both 2"),
        ({"cart_id": 253}, "0 to 252"),
        ({"baud_rate": 123}, "57600"),
        ({"rail_m": -1.0}, "rail_m"),
        ({"pole_zero": 4096}, "0 to 4095"),
    ):
        with pytest.raises(ConfigurationError, match=says):
            DynamixelSettings(**values)
