"""The cart-pole with an ODrive and a pole encoder: frames by hand, the robot contract, faults, a run."""

from __future__ import annotations

import math
import shutil
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.clock import MonotonicClock, VirtualClock
from deal_hw.drivers.cartpole.chips import native
from deal_hw.drivers.cartpole.emulator.odrive_drive import OdriveFirmware
from deal_hw.drivers.cartpole.emulator.odrive_emulator import odrive_device
from deal_hw.drivers.cartpole.emulator.odrive_endpoints import ENABLE_WATCHDOG, WATCHDOG_TIMEOUT
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.drivers.cartpole.robots.odrive_robot import OdriveRobot, odrive_settings
from deal_hw.drivers.cartpole.wire import protocol
from deal_hw.drivers.cartpole.wire.can_link import FRAME, Angle, CanLink
from deal_hw.drivers.cartpole.wire.odrive_frames import CLOSED_LOOP, IDLE, AxisError, Command, pack
from deal_hw.drivers.cartpole.wire.odrive_link import ENCODER_KIND, OdriveLink, OdriveSettings, drive_command
from deal_hw.drivers.transports.virtual_transport import VirtualTransport
from deal_hw.errors import (
    ConfigurationError,
    FrameError,
    SafetyError,
    TransportError,
    TransportTimeoutError,
    WrongDeviceError,
)
from deal_hw.robots.connect import make_robot
from deal_hw.testing.fake_device import FakeDevice
from deal_hw.testing.faults import FaultRates, FaultyTransport, FrameFaults, OneBadFrame, RecordFaults
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Message
from deal_hw.types import RobotState, Status
from deal_hw.workflows.emulation.process import EmulatorProcess
from deal_hw.workflows.running.commander import HOLDS_LAST_COMMAND

MS = 1_000_000
PARTS = OdriveSettings()
WATCHED = OdriveSettings(enable_watchdog=ENABLE_WATCHDOG, watchdog_timeout=WATCHDOG_TIMEOUT)
TARGET = protocol.Target(3, 10_000, 80_000, 8_000, 4_000, 1_000_000)


def frames(data: bytes) -> list[tuple[int, bytes]]:
    """Return ids and data."""
    return [(identifier, payload[:length]) for identifier, length, payload in FRAME.iter_unpack(data)]


def fake(answer: bytes, parts: OdriveSettings = PARTS) -> OdriveRobot:
    """Return a driver in front of nodes that always say the same."""
    clock = VirtualClock()
    return OdriveRobot(VirtualTransport(FakeDevice(answer), clock), clock, parts)


def heartbeat(state: int = IDLE, errors: int = 0) -> bytes:
    """Return what an ODrive says of itself."""
    return pack(PARTS.drive, Command.HEARTBEAT, errors, state, 0, 0)


def encoder_info(kind: str = ENCODER_KIND, version: int = 1) -> bytes:
    """Return what a pole encoder says of itself."""
    info = protocol.Info(1, kind, (2, 3, 4), 1000, 200, 1)
    return CanLink(PARTS.encoder, version).encode(info)


class Wire:
    """An emulated drive and encoder, and the driver in front of them."""

    def __init__(
        self, parts: OdriveSettings = WATCHED, fault: FrameFaults | None = None, firmware: str = "python"
    ) -> None:
        self.clock = VirtualClock()
        self.device = odrive_device(nominal_truth("ideal"), parts, firmware=firmware)
        self.virtual = VirtualTransport(self.device, self.clock)
        self.robot = OdriveRobot(FaultyTransport(self.virtual, received=fault), self.clock, parts)

    def armed(self) -> OdriveRobot:
        """Return the driver, connected, homed and armed."""
        self.robot.connect()
        self.robot.home(5.0)
        self.robot.arm(2.0)
        return self.robot

    def newest(self) -> RobotState:
        """Return the newest state."""
        state = self.robot.read_state(1.0)
        while True:
            try:
                state = self.robot.read_state(0.0)
            except TransportTimeoutError:
                return state


class TestOdriveRobot(RobotSuite):
    firmware = "python"

    @pytest.fixture
    def bench(self) -> RobotBench:
        fault = OneBadFrame(-3)
        wire = Wire(fault=fault, firmware=self.firmware)

        return RobotBench(
            robot=wire.robot,
            foreign=fake(heartbeat() + encoder_info("toaster")),
            newer=fake(heartbeat() + encoder_info(version=2)),
            silent=fake(b""),
            unplug=wire.virtual.unplug,
            corrupt=fault.corrupt_next,
        )


@pytest.mark.skipif(
    shutil.which(native.compiler()) is None, reason="no C compiler: apt-get install gcc libc6-dev"
)
class TestOdriveRobotWithTheCore(TestOdriveRobot):
    """The contract with the encoder node's frames from the firmware's C core."""

    firmware = "host"


# Frames by hand.


def test_a_target_by_hand() -> None:
    """80 N/m and 8 N s/m on a belt of 40 mm a turn, 4 N, a motor of 0.03 N m/A.

    pos_gain = 80 / 8 = 10 (rev/s)/rev. A torque gives 2 pi / 0.04 = 157.08 N/(N m) of force. vel_gain:
    8 N s/m at 1 rev/s = 0.04 m/s is 0.32 N, so 0.32 / 157.08 = 2.0372e-3 N m/(rev/s). 4 N are 25.465 mN m,
    so 0.84883 A.
    """
    parts = OdriveSettings(metres_per_turn=0.04, torque_constant=0.03, velocity_limit_m_s=8.0)
    reported = drive_command(TARGET, parts)
    assert reported.pos_gain == pytest.approx(10.0)
    assert reported.vel_gain == pytest.approx(2.0372e-3, rel=1e-4)
    assert reported.velocity_limit == pytest.approx(200.0)
    assert reported.current_limit == pytest.approx(0.84883, rel=1e-4)
    link = OdriveLink(parts, VirtualClock())
    found = frames(link.encode(TARGET))
    assert [identifier for identifier, _ in found] == [0x1A, 0x1B, 0x0F, 0x0C]
    assert found[0][1] == struct.pack("<f", 10.0)
    # 10 mm are a quarter of a turn; the feed-forward fields are zero.
    assert found[3][1] == struct.pack("<fhh", 0.25, 0, 0)


def test_the_gains_are_the_description_s_law() -> None:
    """Torque = vel_gain * (pos_gain * (target - pos) - vel), in newtons, is kp * (x* - x) - kd * v."""
    reported = drive_command(TARGET, PARTS)
    x, v = -0.03, 0.2
    turns, speed = x / PARTS.metres_per_turn, v / PARTS.metres_per_turn
    torque = reported.vel_gain * (reported.pos_gain * (0.01 / PARTS.metres_per_turn - turns) - speed)
    assert torque * PARTS.newtons_per_nm == pytest.approx(80 * (0.01 - x) - 8 * v)


def test_stiffness_without_damping_is_refused() -> None:
    """The drive's cascade cannot do it."""
    with pytest.raises(FrameError, match="damping above 0"):
        drive_command(protocol.Target(0, 0, 80_000, 0, 4_000, 1_000_000), PARTS)
    drive_command(protocol.Target(0, 0, 0, 0, 0, 0), PARTS)


@pytest.mark.parametrize(
    ("command", "values", "data"),
    [
        (Command.SET_AXIS_STATE, (8,), "08000000"),
        (Command.SET_CONTROLLER_MODE, (3, 1), "0300000001000000"),
        (Command.CLEAR_ERRORS, (0,), "00"),
        (Command.RX_SDO, (1, 0x1B5, b"\1\0\0\0"), "01b5010001000000"),
        (Command.HEARTBEAT, (0x200, 8, 0, 1), "0002000008000100"),
        (Command.ENCODER_ESTIMATES, (1.0, -2.0), "0000803f000000c0"),
        (Command.ESTOP, (), ""),
    ],
)
def test_cansimple_frames_by_hand(command: Command, values: tuple[float | bytes, ...], data: str) -> None:
    """Little-endian, at the offsets of ODrive's documentation; id = node * 32 + number."""
    ((identifier, payload),) = frames(pack(5, command, *values))
    assert identifier == 5 * 32 + command
    assert payload.hex() == data


def test_the_set_point_moves_no_faster_than_asked() -> None:
    """1 m/s at 50 Hz is 20 mm a command; what is returned is what was sent."""
    robot = Wire().armed()
    targets = [robot.send_command(default_command(robot, 0.05)).position_target[0] for _ in range(4)]
    start = targets[0] - 0.02
    assert abs(start) < 1e-4
    np.testing.assert_allclose(targets, [start + 0.02, start + 0.04, 0.05, 0.05])


# The link.


def sample(number: int, cart: tuple[float, float] | None = (0.5, 0.0), us: int = -1) -> bytes:
    """Return one sample of drive and encoder."""
    angle = Angle(number & 0xFF, (5000 * number if us < 0 else us) & 0xFFFF_FFFF, 7, 8, int(Status.HOMED))
    drive = b"" if cart is None else pack(PARTS.drive, Command.ENCODER_ESTIMATES, *cart)
    return drive + CanLink(PARTS.encoder).encode(angle)


def states(link: OdriveLink, data: bytes) -> list[protocol.State]:
    """Return the states in frames."""
    return [message for message in link.decode(data) if isinstance(message, protocol.State)]


def test_a_sample_without_the_drives_part_is_refused() -> None:
    """An old cart position must not stand beside a new angle."""
    link = OdriveLink(PARTS, VirtualClock())
    found = states(link, sample(0) + sample(1, cart=None) + sample(2))
    assert [state.sequence for state in found] == [0, 2]
    assert link.errors == 0


def test_numbers_and_time_go_on_where_their_fields_wrap() -> None:
    """The byte after 255 is 256, and 32 bits of microseconds last 71 minutes."""
    link = OdriveLink(PARTS, VirtualClock())
    found = states(
        link, sample(254) + sample(255) + sample(256) + sample(257, us=2**32 - 1) + sample(258, us=999)
    )
    assert [state.sequence for state in found] == [254, 255, 256, 257, 258]
    assert [state.device_us for state in found[-2:]] == [2**32 - 1, 2**32 + 999]


def test_a_state_names_the_newest_command_that_was_sent_before_it() -> None:
    """Sent 3 ms after the sample at 5 ms: that at 7.999 ms is without it, that at 10 ms has it for 2 ms."""
    clock = VirtualClock()
    link = OdriveLink(PARTS, clock)
    states(link, sample(1))
    clock.advance_ns(3 * MS)
    link.encode(TARGET)
    (before,) = states(link, sample(2, us=7_999))
    clock.advance_ns(2 * MS)
    (after,) = states(link, sample(3, us=10_000))
    assert (before.command_sequence, before.command_age_us) == (protocol.NO_COMMAND, 0)
    assert (after.command_sequence, after.command_age_us) == (3, 2_000)


def test_a_sample_that_is_read_late_does_not_move_the_commands() -> None:
    """A sample is read 9 ms late, and the next command is sent then: it is placed by the fastest samples."""
    clock = VirtualClock()
    link = OdriveLink(PARTS, clock)
    states(link, sample(1))
    clock.advance_ns(14 * MS)
    states(link, sample(2, us=10_000))
    link.encode(TARGET)
    clock.advance_ns(6 * MS)
    (after,) = states(link, sample(3, us=25_000))
    assert (after.command_sequence, after.command_age_us) == (3, 6_000)


def test_values_that_are_none_are_counted() -> None:
    """NaN from a drive without an encoder is no position."""
    link = OdriveLink(PARTS, VirtualClock())
    assert states(link, sample(0, cart=(math.nan, 0.0))) == []
    assert link.errors == 1


def test_a_heartbeat_that_stays_away_is_a_fault() -> None:
    """200 ms by the encoder's clock: 40 samples go by, the 41st is too many."""
    link = OdriveLink(PARTS, VirtualClock())
    list(link.decode(heartbeat()))
    for number in range(41):
        states(link, sample(number))
    assert link.fault == ""
    states(link, sample(41))
    assert "205 ms old" in link.fault


def test_a_silence_of_the_whole_bus_is_no_missing_heartbeat() -> None:
    """What waited in a buffer, then 6 s later: the heartbeat has another 200 ms."""
    link = OdriveLink(PARTS, VirtualClock())
    list(link.decode(heartbeat()))
    states(link, sample(1) + sample(1226))
    assert link.fault == ""
    for number in range(1227, 1268):
        states(link, sample(number))
    assert "205 ms old" in link.fault


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.integers(0, 8), st.binary(max_size=8)), max_size=30))
def test_nothing_on_the_bus_makes_the_link_fail(junk: list[tuple[int, int, bytes]]) -> None:
    """Frames of drive and encoder with any content; a whole sample is found afterwards."""
    link = OdriveLink(PARTS, VirtualClock())
    for identifier, length, data in junk:
        node = (PARTS.drive, PARTS.encoder)[identifier & 1]
        for message in link.decode(FRAME.pack(node << 5 | identifier >> 1 & 0x1F, length, data)):
            assert not isinstance(message, protocol.Target)
        assert isinstance(link.fault, str)
    assert len(states(link, sample(0))) == 1


@settings(deadline=None)
@given(
    st.builds(
        protocol.Target,
        st.integers(0, 2**32 - 2),
        st.integers(-(2**31), 2**31 - 1),
        st.integers(0, 2**32 - 1),
        st.integers(1, 2**32 - 1),
        st.integers(0, 2**16 - 1),
        st.integers(0, 2**32 - 1),
    )
)
def test_every_target_makes_finite_frames(target: protocol.Target) -> None:
    """Whatever the safety filter lets through, and more."""
    for _, data in frames(OdriveLink(PARTS, VirtualClock()).encode(target)):
        if len(data) >= 4:
            assert math.isfinite(struct.unpack_from("<f", data)[0])


# The robot.


def test_the_drives_own_watchdog_stops_the_motor() -> None:
    """Its settings are written and read back in connect; 200 ms of silence disarm, arming clears it."""
    wire = Wire()
    robot = wire.armed()
    assert robot.watchdog_s == 0.2
    robot.send_command(default_command(robot))
    wire.clock.advance_ns(300 * MS)
    state = wire.newest()
    assert Status.WATCHDOG in state.status
    assert Status.ARMED not in state.status
    assert "WATCHDOG_TIMER_EXPIRED" in robot.fault
    robot.home(5.0)
    robot.arm(2.0)
    assert wire.newest().status == Status.HOMED | Status.ARMED
    assert robot.fault == ""


def test_without_the_watchdogs_numbers_the_operator_is_told() -> None:
    """The robot then says that it holds its last command."""
    wire = Wire(PARTS)
    robot = wire.armed()
    assert robot.watchdog_s == 0.0
    printed = HOLDS_LAST_COMMAND.format(robot="cartpole", stopped_by=robot.stopped_by) + robot.if_cut
    assert (
        printed.count("the power supply of its drive") == 2
        and "remote" not in printed
        and "bridge" not in printed
    )
    robot.send_command(default_command(robot))
    wire.clock.advance_ns(1000 * MS)
    assert Status.ARMED in wire.newest().status


def test_a_watchdog_that_is_not_confirmed_is_refused() -> None:
    """Another firmware numbers its settings otherwise: the write goes nowhere."""
    parts = OdriveSettings(enable_watchdog=1000, watchdog_timeout=1001)
    with pytest.raises(WrongDeviceError, match="flat_endpoints"):
        Wire(parts).robot.connect()


def test_arming_needs_a_homing_in_this_connection() -> None:
    """The drive counts from its power-on: only homing says where the middle is."""
    wire = Wire()
    wire.robot.connect()
    with pytest.raises(SafetyError, match="home"):
        wire.robot.arm(1.0)
    wire.robot.home(5.0)
    assert abs(wire.newest().position[0]) < 1e-3
    wire.robot.disconnect()
    wire.robot.connect()
    assert Status.HOMED not in wire.newest().status
    with pytest.raises(SafetyError, match="home"):
        wire.robot.arm(1.0)


def test_samples_from_before_a_second_homing_do_not_end_it() -> None:
    """100 ms of samples wait that say homed, with the cart 0.1 m off the middle."""
    wire = Wire()
    robot = wire.armed()
    for _ in range(50):
        robot.send_command(default_command(robot, 0.1))
        wire.clock.advance_ns(20 * MS)
    robot.passive()
    assert wire.newest().position[0] > 0.09
    wire.clock.advance_ns(100 * MS)
    robot.home(5.0)
    assert wire.newest().position[0] == pytest.approx(wire.device.true_position[0], abs=1e-3)


def test_an_encoder_that_restarts_is_a_fault() -> None:
    """Its angle begins at pi again: the run ends, and arming needs another homing."""
    wire = Wire()
    robot = wire.armed()
    assert robot.fault == ""
    drive = wire.device.firmware
    assert isinstance(drive, OdriveFirmware)
    fresh = odrive_device(nominal_truth("ideal"), WATCHED).firmware
    assert isinstance(fresh, OdriveFirmware)
    drive.encoder = fresh.encoder
    wire.clock.advance_ns(20 * MS)
    assert Status.HOMED not in wire.newest().status
    assert "the pole encoder is no longer homed" in robot.fault
    robot.passive()
    with pytest.raises(SafetyError, match="home"):
        robot.arm(1.0)
    robot.home(5.0)
    robot.arm(2.0)
    assert robot.fault == ""


def test_an_error_of_the_drive_is_decoded() -> None:
    """Its bits become names, and the robot is no longer armed."""
    wire = Wire()
    robot = wire.armed()
    wire.device.receive(pack(PARTS.drive, Command.ESTOP))
    wire.clock.advance_ns(100 * MS)
    assert Status.ARMED not in wire.newest().status
    assert Status.FAULT in wire.newest().status
    assert "ESTOP_REQUESTED" in robot.fault


@pytest.mark.parametrize(
    "frame",
    [
        pack(PARTS.drive, Command.SET_INPUT_POS, 1.0, 0, 0),
        pack(PARTS.drive, Command.SET_AXIS_STATE, CLOSED_LOOP),
        FRAME.pack(PARTS.drive << 5 | 0x0D, 8, bytes(8)),
    ],
    ids=["Set_Input_Pos", "closed loop", "Set_Input_Vel"],
)
def test_a_second_host_that_commands_the_drive_ends_a_run(frame: bytes) -> None:
    """Two hosts would take turns at the motor; a rival's frame before our own commands is none."""
    wire = Wire()
    wire.robot.connect()
    other = Message("", frame, wire.clock.now_ns())
    wire.virtual._queue.append(other)
    wire.newest()
    assert wire.robot.fault == ""
    robot = wire.armed()
    wire.newest()
    assert robot.fault == ""
    wire.virtual._queue.append(other)
    wire.clock.advance_ns(10 * MS)
    wire.newest()
    assert "another program or computer commands the ODrive at node 0" in robot.fault


def test_a_second_host_that_switches_the_drive_off_is_no_rival() -> None:
    """Anybody may stop the motor; the drive itself reports that it is idle."""
    wire = Wire()
    robot = wire.armed()
    wire.virtual._queue.append(Message("", pack(PARTS.drive, Command.SET_AXIS_STATE, IDLE), 0))
    wire.clock.advance_ns(10 * MS)
    wire.newest()
    assert robot.fault == ""


def test_a_wrong_node_is_named() -> None:
    """Without the drive's heartbeat, or without the encoder's answer."""
    with pytest.raises(WrongDeviceError, match="no heartbeat of an ODrive at node 0"):
        fake(encoder_info()).connect()
    with pytest.raises(WrongDeviceError, match="the pole encoder at node 2 does not answer"):
        fake(heartbeat()).connect()


def test_two_encoders_under_one_number_are_a_fault() -> None:
    """Their heartbeats tell them apart."""
    link = OdriveLink(PARTS, VirtualClock())
    for identity in (1, 2):
        list(link.decode(CanLink(PARTS.encoder, unique_id=identity).encode(Angle(0, 0, 0, 0, 0))))
    assert "two devices use node 2" in link.fault


def test_five_percent_of_lost_frames_are_survived() -> None:
    """Requests are repeated; samples that lost a part are refused whole."""
    faults = RecordFaults(FaultRates(drop=0.05), np.random.default_rng(3), size=FRAME.size, header=8)
    wire = Wire(fault=faults)
    robot = wire.armed()
    # What waited since connect still counts from the drive's power-on.
    sequences = [wire.newest().sequence]
    for k in range(200):
        robot.send_command(default_command(robot, 0.05 * (k % 2)))
        for _ in range(3):
            state = robot.read_state(0.5)
            sequences.append(state.sequence)
            assert abs(state.position[0]) < 0.41
    assert sequences == sorted(set(sequences))
    assert robot.transport_errors > 20


# Ports and runs.


def test_a_port_says_how_the_parts_are_joined() -> None:
    """Node numbers, pulley, motor and the watchdog's settings."""
    bus, parts = odrive_settings(
        "can0?node=5&encoder=6&mm_per_turn=60&kv=150&enable_watchdog=437&watchdog_timeout=438"
    )
    assert bus == "can0"
    assert (parts.drive, parts.encoder, parts.metres_per_turn) == (5, 6, 0.06)
    assert parts.torque_constant == pytest.approx(0.05513, rel=1e-3)
    assert (parts.enable_watchdog, parts.watchdog_timeout) == (437, 438)
    assert odrive_settings("can0?node=0") == ("can0", OdriveSettings())


@pytest.mark.parametrize(
    "query", ["node=63", "node=2", "encoder=63", "enable_watchdog=437", "watchdog_timeout=438", "volts=24"]
)
def test_parts_that_do_not_fit_are_refused(query: str) -> None:
    """Numbers that no node has, the same for both, half of the watchdog, an unknown word."""
    with pytest.raises(ConfigurationError):
        odrive_settings(f"can0?{query}")


@pytest.mark.real_time
def test_another_encoder_number_is_refused_over_the_adapter() -> None:
    """As a user sees it who forgot the number."""
    with EmulatorProcess("cartpole", "--transport", "odrive", "--profile", "ideal", "--nominal") as emulator:
        robot = make_robot("cartpole", "odrive", emulator.port + "&encoder=9", MonotonicClock())
        with pytest.raises((WrongDeviceError, TransportError), match="node 9"):
            robot.connect()


def test_a_confirmed_write_is_no_error() -> None:
    """From firmware 0.6.11 on a drive answers a write with the setting's number alone."""
    link = OdriveLink(PARTS, VirtualClock())
    data = struct.pack("<BHx", 0, ENABLE_WATCHDOG)
    list(link.decode(FRAME.pack(PARTS.drive << 5 | Command.TX_SDO, len(data), data)))
    assert link.errors == 0


def test_axis_states_have_the_drives_numbers() -> None:
    """As ODrive's documentation has them."""
    assert (IDLE, CLOSED_LOOP) == (1, 8)
    assert AxisError(0x0100_0200) == AxisError.WATCHDOG_TIMER_EXPIRED | AxisError.DC_BUS_UNDER_VOLTAGE
