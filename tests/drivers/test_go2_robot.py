"""The Go2's driver on a virtual wire: the robot contract, connecting, states, commands, passive."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from fakes.go2 import RESTING, STIFF, FakeBench, FakeGo2

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.drivers.go2.messages.low_command import decode_low_command
from deal_hw.drivers.go2.messages.low_state import decode_low_state, encode_low_state
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.rpc import encode_note
from deal_hw.errors import (
    FrameError,
    SafetyError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.types import RobotState, Status

MS = 1_000_000


def flip(payload: bytes) -> list[bytes]:
    """Change a byte of a joint's position."""
    return [payload[:90] + bytes([payload[90] ^ 0x55]) + payload[91:]]


def faked(change: Callable[[bytes], Iterable[bytes]]) -> Go2Robot:
    """Return a driver in front of a robot all of whose states are changed."""
    wire = FakeBench()
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else (payload,)
    return wire.robot


class TestGo2Robot(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        wire, silent = FakeBench(), FakeBench()
        silent.device.talks = False
        return RobotBench(
            robot=wire.robot,
            foreign=faked(lambda payload: [payload + bytes(100)]),
            newer=faked(flip),
            silent=silent.robot,
            unplug=wire.topics.unplug,
            corrupt=lambda: wire.spoil_once(flip),
            greets=False,
        )


# Connecting.


@pytest.mark.parametrize(("volts", "refused"), [(0.0, False), (33.6, False), (math.nan, False), (50.4, True)])
def test_a_b2_is_known_by_its_supply(volts: float, refused: bool) -> None:
    """Its messages are the Go2's, but its 14 cells have at least 42 V; nothing is sent to it."""
    wire = FakeBench()
    wire.device.changes = {"voltage": volts}
    if refused:
        with pytest.raises(WrongDeviceError, match=r"50\.4 V.*at most 40 V.*`b2`.*Nothing was sent"):
            wire.robot.connect()
    else:
        wire.robot.connect()
    assert wire.device.received == [] and wire.device.requests == []


def test_connecting_sends_nothing_and_learns_of_battery_and_firmware() -> None:
    """Whoever only looks, changes nothing."""
    wire = FakeBench()
    wire.robot.connect()
    assert wire.robot.info is not None
    assert (wire.robot.info.battery, wire.robot.info.voltage) == (0.77, 30.5)
    assert (wire.robot.info.serial, wire.robot.info.version) == ((1, 2), (3, 4))
    assert wire.device.received == [] and wire.device.requests == []
    assert wire.robot.fileno() == -1


def test_another_robot_type_is_named_by_its_length() -> None:
    """A G1's states are longer: both lengths are in the message."""
    with pytest.raises(WrongDeviceError, match=r"1280 bytes.*1180.*G1"):
        faked(lambda payload: [payload + bytes(100)]).connect()


def test_a_c_struct_is_named_as_such() -> None:
    """The right length, no CDR header."""
    with pytest.raises(WrongDeviceError, match="C struct"):
        faked(lambda payload: [payload[4:] + bytes(4)]).connect()


def test_silence_comes_with_advice() -> None:
    """Cable, interface, firewall, bridge; and who discovery sees."""
    wire = FakeBench()
    wire.device.talks = False
    wire.topics.others = {topics.LOW_STATE: ("Cyclone DDS 01ab",)}
    with pytest.raises(TransportTimeoutError, match=r"Cyclone DDS 01ab.*192\.168\.123.*firewall.*bridge"):
        wire.robot.connect()


def test_a_standing_clock_is_no_robot() -> None:
    """States whose tick never moves are no sign of life."""
    wire = FakeBench()
    wire.device.tick_step = 0
    with pytest.raises(TransportTimeoutError, match="stands still at 1000 ms"):
        wire.robot.connect()


def test_two_robots_on_one_network_are_refused() -> None:
    """Half of what comes is old news of the other; who they are is reported where discovery knows."""
    wire = FakeBench()
    wire.topics.others = {topics.LOW_STATE: ("robot one", "robot two")}
    other = FakeGo2()
    other.tick_ms = 600

    def both(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic != topics.LOW_STATE:
            return (payload,)
        other.tick_ms += 2
        return payload, encode_low_state(other.state())

    wire.topics.tamper = both
    with pytest.raises(WrongDeviceError, match=r"two robots.*robot one; robot two"):
        wire.robot.connect()


def test_a_failed_connect_closes_the_transport() -> None:
    """Another attempt starts afresh."""
    wire = FakeBench()
    wire.device.talks = False
    with pytest.raises(TransportTimeoutError):
        wire.robot.connect()
    with pytest.raises(TransportLostError, match="not open"):
        wire.topics.receive(0.0)
    wire.device.talks = True
    wire.robot.connect()
    assert wire.robot.transport_errors == 0


def test_nothing_works_before_connecting() -> None:
    """Each says what is missing."""
    robot = FakeBench().robot
    calls: tuple[Callable[[], object], ...] = (lambda: robot.home(1.0), lambda: robot.arm(1.0))
    for call in calls:
        with pytest.raises(SafetyError, match="connect"):
            call()
    with pytest.raises(TransportError):
        robot.passive()


# States.


def drained(robot: Go2Robot, count: int) -> list[RobotState]:
    """Return that many states."""
    return [robot.read_state(0.1) for _ in range(count)]


@pytest.mark.parametrize(
    ("change", "errors"),
    [
        (lambda payload: [], 1),
        (lambda payload: [payload, payload], 1),
        (flip, 2),
        (lambda payload: [payload[:-1]], 2),
        (lambda payload: [b"\xfe\xef" + payload[2:]], 2),
    ],
    ids=["lost", "duplicated", "corrupt", "cut short", "no header"],
)
def test_broken_states_are_counted(change: Callable[[bytes], list[bytes]], errors: int) -> None:
    """A corrupt state counts twice, itself and its gap; none reaches the caller, time goes on growing."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.read_state(0.1)
    wire.spoil_once(change)
    states = drained(wire.robot, 10)
    assert wire.robot.transport_errors == errors
    steps = np.diff([state.device_ns for state in states]) // MS
    assert set(steps.tolist()) <= {2, 4}
    assert np.diff([state.sequence for state in states]).tolist() == (steps // 2).tolist()


def test_an_overtaken_state_is_dropped() -> None:
    """Two states that come in the wrong order: the older one is late, and old news."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    kept: list[bytes] = []

    def swap(topic: str, payload: bytes) -> list[bytes]:
        if topic == topics.LOW_STATE and len(kept) < 2:
            kept.append(payload)
            return kept[::-1] if len(kept) == 2 else []
        return [payload]

    wire.topics.tamper = swap
    states = drained(wire.robot, 5)
    # One gap before the newer of the two, and the older.
    assert wire.robot.transport_errors == 2
    assert (np.diff([state.device_ns for state in states]) > 0).all()


def test_a_clock_that_stops_ends_in_a_timeout_that_says_so() -> None:
    """The robot repeats its last state: none of that is fresh."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.read_state(0.1)
    wire.device.tick_step = 0
    wire.robot.read_state(0.1)
    with pytest.raises(TransportTimeoutError, match="clock stands still"):
        wire.robot.read_state(0.1)
    assert wire.robot.transport_errors >= 45


def test_the_clock_may_wrap() -> None:
    """After 49.7 days, 32 bits of milliseconds begin at 0 again."""
    wire = FakeBench(mode="")
    wire.device.tick_ms = 2**32 - 20
    wire.robot.connect()
    states = drained(wire.robot, 20)
    assert set(np.diff([state.device_ns for state in states]).tolist()) == {2 * MS}
    assert wire.robot.transport_errors == 0


def test_a_robot_that_was_restarted_is_lost() -> None:
    """Its clock begins again, and so does sport mode: nobody may go on as if nothing were."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    wire.device.tick_ms = 0
    with pytest.raises(TransportLostError, match="restarted"):
        drained(robot, 3)
    assert make_passive(robot, wire.clock)


def test_a_state_with_nan_passes() -> None:
    """It is sound as a message; what to do about it is the safety module's decision."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.home(5.0)
    wire.device.pose[4] = np.nan
    assert np.isnan(drained(wire.robot, 2)[-1].position[4])
    wire.robot.arm(1.0)
    assert all(np.isfinite(command.position).all() for _, command in wire.device.received)


def ruled_otherwise(payload: bytes) -> list[bytes]:
    """Make a state as a simulator does that leaves head and checksum out."""
    return [payload[:4] + bytes(2) + payload[6:-4] + bytes(4)]


def lenient(change: Callable[[bytes], Iterable[bytes]]) -> tuple[FakeBench, Go2Robot]:
    """Return a wire whose states are changed, and a driver that looks at their length only."""
    wire = FakeBench(mode="")
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else (payload,)
    return wire, Go2Robot(wire.topics, wire.clock, state_check="length")


def test_head_and_checksum_can_be_left_alone() -> None:
    """For firmware and simulators that make others: such a robot is armed, and obeys."""
    wire, robot = lenient(ruled_otherwise)
    robot.connect()
    robot.home(5.0)
    robot.arm(1.0)
    assert robot.read_state(0.1).position.shape == (12,)
    assert robot.transport_errors == 0 and len(wire.device.received) == 1


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda payload: [payload + bytes(4)], "1184 bytes"),
        (lambda payload: [payload[4:] + bytes(4)], "C struct|CDR header"),
        (lambda payload: [b"\0\0" + payload[2:]], "CDR header"),
    ],
    ids=["length", "struct", "encoding"],
)
def test_length_and_encoding_count_whatever_is_left_alone(
    change: Callable[[bytes], Iterable[bytes]], match: str
) -> None:
    """Without them there is nothing to read."""
    with pytest.raises(WrongDeviceError, match=match):
        lenient(change)[1].connect()


def test_the_clock_counts_whatever_is_left_alone() -> None:
    """A simulator that leaves the tick at 0, too, is still refused."""
    wire, robot = lenient(ruled_otherwise)
    wire.device.tick_step = 0
    with pytest.raises(TransportTimeoutError, match="clock stands still"):
        robot.connect()


def test_an_unknown_check_is_refused() -> None:
    """By its name, with those there are."""
    wire = FakeBench()
    with pytest.raises(UnknownNameError, match="strict, length"):
        Go2Robot(wire.topics, wire.clock, state_check="crc")  # type: ignore[arg-type]


# Commands.


def test_arming_damps_and_says_so() -> None:
    """The first thing that the motors hear is damping at the measured pose."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    _, command = wire.device.received[0]
    assert not command.stiffness.any() and (command.damping == 5.0).all() and (command.mode == 1).all()
    np.testing.assert_allclose(command.position, RESTING, atol=1e-6)
    assert robot.last_sequence == -1
    assert robot.read_state(0.1).status == Status.HOMED | Status.ARMED


def test_a_silent_robot_is_not_armed() -> None:
    """States must follow the first command."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.home(5.0)
    wire.device.talks = False
    with pytest.raises(TransportTimeoutError, match="no new states"):
        wire.robot.arm(0.2)


def test_nothing_is_sent_before_arming() -> None:
    """Neither commands nor repeats."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.repeat()
    with pytest.raises(SafetyError, match="arm"):
        wire.robot.send_command(default_command(wire.robot))
    wire.robot.read_state(0.1)
    assert wire.device.received == []


def test_a_command_reaches_the_motors_as_it_was() -> None:
    """All five parts, in model order, each with its own numbers; limits are the description's."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    wish = dataclasses.replace(
        default_command(robot),
        position_target=np.arange(12) / 7,
        velocity_target=np.arange(12) / 11,
        stiffness=np.arange(12, dtype=np.float64) + 1.3,
        damping=np.arange(12.0) / 13,
        effort=np.arange(12.0) / 17,
        effort_limit=np.zeros(12),
        speed_limit=np.zeros(12),
    )
    sent = robot.send_command(wish)
    robot.read_state(0.1)
    _, received = wire.device.received[-1]
    for ours, theirs in (
        ("position_target", "position"),
        ("velocity_target", "velocity"),
        ("stiffness", "stiffness"),
        ("damping", "damping"),
        ("effort", "effort"),
    ):
        np.testing.assert_array_equal(getattr(sent, ours), getattr(received, theirs), ours)
        np.testing.assert_allclose(getattr(sent, ours), getattr(wish, ours), rtol=1e-7)
    assert sent.effort_limit.tolist() == list(DRIVER.effort_limit)
    assert np.isinf(sent.speed_limit).all()


def test_repeats_are_the_same_bytes_and_no_new_command() -> None:
    """500 times a second the drives hear what they received before; number and age go by the first."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot, target=0.5))
    drained(robot, 5)
    before = len(wire.device.received)
    for _ in range(3):
        robot.repeat()
        state = robot.read_state(0.1)
    assert len(wire.device.received) == before + 3
    np.testing.assert_array_equal(
        wire.device.received[-1][1].position, wire.device.received[before - 1][1].position
    )
    assert state.command_sequence == robot.last_sequence == 0
    assert state.command_age_ns >= 14 * MS


def test_a_state_names_the_command_before_it() -> None:
    """Not one that went out when the state was already under way, as it is on a slow link."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    first = robot.read_state(0.1)
    wire.clock.advance_ns(7 * MS)
    robot.send_command(default_command(robot))
    states = drained(robot, 10)
    sent_ns = first.device_ns + 7 * MS
    for state in states:
        assert state.command_sequence == (0 if state.device_ns > sent_ns else -1)
        if state.command_sequence == 0:
            assert state.command_age_ns == state.device_ns - sent_ns


def test_a_clock_that_stood_still_places_commands_right_again() -> None:
    """A robot's computer that paused is behind for good: ages go by how late its states come since."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    wire.device.talks = False
    with pytest.raises(TransportTimeoutError):
        robot.read_state(0.08)
    wire.device.talks = True
    drained(robot, 1100)
    robot.send_command(default_command(robot))
    aged = [state.command_age_ns for state in drained(robot, 10) if state.command_sequence == 0]
    assert aged[:3] == [2 * MS, 4 * MS, 6 * MS]


def test_absurd_numbers_are_not_sent() -> None:
    """Finite is not enough: 1e30 rad is nobody's wish."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    with pytest.raises(SafetyError, match="finite"):
        robot.send_command(default_command(robot, target=1e30))
    assert robot.last_sequence == -1


# Passive.


def test_passive_is_damping_sent_three_times() -> None:
    """The robot holds it for ever, and messages get lost."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    robot.passive()
    robot.read_state(0.1)
    for _, command in wire.device.received[-3:]:
        assert not command.stiffness.any() and not command.effort.any() and not command.velocity.any()
        assert (command.damping == 5.0).all()
    sent = robot.send_command(default_command(robot))
    assert not sent.stiffness.any()


def test_passive_is_confirmed_by_efforts_not_by_hope() -> None:
    """A robot that pushes on after 10 ms is still armed; one whose drives brake is not."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    drained(robot, 5)
    held = wire.device.command
    wire.device.hears = False
    robot.passive()
    assert all(Status.ARMED in state.status for state in drained(robot, 20))
    wire.device.hears = True
    assert held is not None
    # Legs that sink at 2 rad/s are braked with 10 N·m each.
    wire.device.velocity = np.full(12, 2.0)
    robot.passive()
    states = drained(robot, 10)
    armed = [Status.ARMED in state.status for state in states]
    assert armed[:4] == [True] * 4 and armed[-1] is False


def test_make_passive_reports_what_the_robot_shows() -> None:
    """True where the efforts fall, false where they stay."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    drained(robot, 5)
    assert make_passive(robot, wire.clock)
    robot.arm(1.0)
    robot.send_command(default_command(robot))
    drained(robot, 5)
    wire.device.hears = False
    assert not make_passive(robot, wire.clock)


def status(control: str, reason: str = "no admissible command") -> bytes:
    """Return what a bridge says."""
    return encode_note({"control": control, "reason": reason})


def test_a_bridge_that_took_the_robot_is_a_fault_with_its_reason() -> None:
    """What it reported before the arming, or just after it, is from before; its own hand-over is none."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    wire.topics.say(topics.BRIDGE, status("damping"), 0.05)
    wire.topics.say(topics.BRIDGE, status("controlled"), 0.15)
    wire.topics.say(topics.BRIDGE, b"rubbish", 0.16)
    drained(robot, 200)
    assert robot.fault == ""
    wire.topics.say(topics.BRIDGE, status("damping"), 0.05)
    drained(robot, 100)
    assert robot.fault == "go2: the bridge took the robot from this run: no admissible command"


def test_a_robot_that_another_controls_through_the_bridge_is_not_taken_over() -> None:
    """It is reported before sport mode is asked for anything; one that only listens does not mind."""
    wire = FakeBench()
    wire.robot.connect()
    wire.topics.say(topics.BRIDGE, status("controlled"), 0.001)
    drained(wire.robot, 10)
    wire.topics.say(topics.BRIDGE, status("controlled"), 0.0)
    with pytest.raises(SafetyError, match="another controller commands the robot through the bridge"):
        wire.robot.home(10.0)
    assert wire.device.mode == "normal"
    assert wire.device.received == []


def test_another_process_can_make_it_passive() -> None:
    """The supervisor's own driver, connected long ago, whose queue was left alone, damps within a tick."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.topics.say(topics.LOW_COMMAND, STIFF, 0.5)
    wire.clock.advance_ns(1_000_000_000)
    assert make_passive(wire.robot, wire.clock)
    command = wire.device.command
    assert command is not None and not command.stiffness.any()


def test_the_robot_on_a_stand_is_another_description() -> None:
    """Same wire; no floor, a level stand, the gains of the suspended recording."""
    wire = FakeBench(Go2OnStandRobot, mode="")
    robot = wire.armed()
    assert robot.description.name == "go2_on_stand"
    assert robot.description.floating_base is None
    assert robot.description.limits.legs is not None and robot.description.limits.legs.tilt == 0.35
    assert robot.description.stiffness == (20.0,) * 12


def test_a_lost_connection_speaks_of_no_watchdog() -> None:
    """The Go2 has none: it holds its last command, and only somebody beside it can stop it."""
    printed = FakeBench(mode="").robot.if_cut
    assert "watchdog" not in printed and "still holds its last command" in printed and "remote" in printed


def test_recorded_bytes_can_be_decoded_again() -> None:
    """Raw messages of both directions, as they were on the wire."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    robot.take_wire()
    robot.send_command(default_command(robot, target=0.25))
    robot.read_state(0.1)
    kinds = []
    for message in robot.take_wire():
        try:
            kinds.append((message.channel, type(decode_low_state(message.payload)).__name__))
        except FrameError:
            kinds.append((message.channel, type(decode_low_command(message.payload)).__name__))
    assert ("rx", "LowStateFrame") in kinds and ("tx", "LowCommand") in kinds


@pytest.mark.parametrize("change", [flip, ruled_otherwise], ids=["checksum", "head"])
def test_another_rule_is_said_with_the_switch_and_its_risk(
    change: Callable[[bytes], Iterable[bytes]],
) -> None:
    """States of the right length without one right checksum, or head: update, or leave both out."""
    with pytest.raises(
        VersionMismatchError,
        match=r"another head or checksum.*update deal-hw.*--state-check length.*not detected",
    ):
        faked(change).connect()
