"""The Go2's driver over topics in memory: the robot contract, sport mode, other writers, broken states."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.passive import make_passive
from deal_hw.drivers.go2 import topics
from deal_hw.drivers.go2.driven import DRIVEN
from deal_hw.drivers.go2.protocol import (
    LowCommand,
    LowCommandEncoder,
    LowState,
    decode_low_command,
    decode_low_state,
    encode_low_state,
)
from deal_hw.drivers.go2.remote import Remote, encode_remote, parse_combination
from deal_hw.drivers.go2.robot import Go2HungRobot, Go2Robot
from deal_hw.drivers.go2.rpc import Request, Response, decode_request, encode_response
from deal_hw.errors import (
    FrameError,
    ProtocolError,
    SafetyError,
    TransportError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
    VersionMismatchError,
    WrongDeviceError,
)
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.testing.topic_wire import MemoryTopics
from deal_hw.types import RobotState, Status

RESTING = np.array(DRIVEN.rest_position)
STANDING = np.array(DRIVEN.default_position)
MS = 1_000_000


class ScriptedGo2:
    """A robot that speaks the wire's bytes: joints that never move, drives, sport mode and its services."""

    def __init__(self, mode: str = "normal", pose: np.ndarray = RESTING) -> None:
        self.device_ns = 0
        self.mode, self.pose, self.velocity = mode, pose.copy(), np.zeros(12)
        self.tick_ms, self.tick_step = 1000, 2
        self.command: LowCommand | None = None
        self.heard: list[tuple[int, LowCommand]] = []
        self.requests: list[tuple[str, Request]] = []
        self.deaf: set[str] = set()
        self.codes: dict[tuple[str, int], list[int]] = {}
        self.stubborn = False
        self.remote: Remote | None = None
        self.limp = False
        self.talks = True
        self.changes: dict[str, object] = {}
        self._answers: list[tuple[int, str, bytes]] = []

    def receive(self, topic: str, payload: bytes, stamp_ns: int = 0) -> None:
        """Follow commands at once, answer requests after 3 ms."""
        if topic == topics.LOW_COMMAND:
            self.command = decode_low_command(payload)
            self.heard.append((self.device_ns, self.command))
            return
        service = topic.split("/")[2]
        request = decode_request(payload)
        self.requests.append((service, request))
        if service not in self.deaf:
            code, data = self._serve(service, request)
            answer = encode_response(Response(request.identity, request.api, code, data))
            self._answers.append((self.device_ns + 3 * MS, topics.response(service), answer))

    def _serve(self, service: str, request: Request) -> tuple[int, str]:
        if codes := self.codes.get((service, request.api)):
            if code := codes.pop(0):
                return code, ""
        asked = json.loads(request.parameter)
        if service == "motion_switcher" and request.api == 1001:
            return 0, json.dumps({"form": "0", "name": self.mode})
        if service == "motion_switcher" and request.api == 1002:
            self.mode = "" if self.stubborn else asked["name"]
        elif service == "motion_switcher" and request.api == 1003 and not self.stubborn:
            self.mode = ""
        elif service == "sport" and request.api == 1005 and not self.stubborn:
            self.pose = RESTING.copy()
        elif service == "robot_state" and asked["name"] == "sport_mode":
            self.mode = "normal" if asked["switch"] else ""
        return 0, ""

    def tick(self) -> list[tuple[str, bytes]]:
        """One millisecond; a state every two, sport mode's own commands in between."""
        now_ms = self.device_ns // MS
        self.device_ns += MS
        out = [(topic, data) for due, topic, data in self._answers if due <= self.device_ns]
        self._answers = [entry for entry in self._answers if entry[0] > self.device_ns]
        if not self.talks:
            return out
        if now_ms % 2 == 0:
            out.append((topics.LOW_STATE, encode_low_state(self.state())))
            self.tick_ms = (self.tick_ms + self.tick_step) % 2**32
        elif self.mode:
            out.append((topics.LOW_COMMAND, STIFF))
        return out

    def effort(self) -> np.ndarray:
        """What the drives do with the last command."""
        if self.command is None or self.limp:
            return np.zeros(12)
        c = self.command
        return c.stiffness * (c.position - self.pose) + c.damping * (c.velocity - self.velocity) + c.effort

    def state(self) -> LowState:
        """Return the state now."""
        values: dict[str, object] = {
            "position": self.pose, "velocity": self.velocity, "acceleration": np.zeros(12),
            "effort": self.effort(), "temperature": np.arange(12) + 30, "lost": np.arange(12),
            "mode": np.ones(12, np.int64), "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
            "angular_velocity": np.array([0.1, 0.2, 0.3]), "specific_force": np.array([0.0, 0.0, 9.81]),
            "rpy": np.zeros(3), "imu_temperature": 60, "foot_force": np.array([1, 2, 3, 4]),
            "foot_force_estimate": np.zeros(4, np.int64), "tick_ms": self.tick_ms,
            "remote": encode_remote(self.remote), "battery_percent": 77, "battery_current_ma": -2000,
            "battery_status": 8, "battery_cycles": 1, "cell_voltage_mv": np.full(15, 3900), "voltage": 30.5,
            "current": 2.0, "serial": (1, 2), "version": (3, 4),
        }  # fmt: skip
        return LowState(**{**values, **self.changes})  # type: ignore[arg-type]


STIFF = LowCommandEncoder().encode(
    LowCommand(STANDING, np.zeros(12), np.full(12, 60.0), np.full(12, 5.0), np.zeros(12))
)


class Wire:
    """A scripted robot, the driver, and the topics between them."""

    def __init__(self, kind: type[Go2Robot] = Go2Robot, **settings: object) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.device = ScriptedGo2(**settings)  # type: ignore[arg-type]
        self.topics = MemoryTopics(self.device, self.clock)
        self.robot = kind(self.topics, self.clock)

    def armed(self) -> Go2Robot:
        """Return the driver, connected, homed and armed."""
        self.robot.connect()
        self.robot.home(10.0)
        self.robot.arm(1.0)
        return self.robot

    def tamper_once(self, change: Callable[[bytes], Iterable[bytes]]) -> None:
        """Let the next state arrive changed."""
        pending = [True]

        def tamper(topic: str, payload: bytes) -> Iterable[bytes]:
            if topic == topics.LOW_STATE and pending and pending.pop():
                return change(payload)
            return (payload,)

        self.topics.tamper = tamper


def flip(payload: bytes) -> list[bytes]:
    """Change a byte of a joint's position."""
    return [payload[:90] + bytes([payload[90] ^ 0x55]) + payload[91:]]


def scripted(change: Callable[[bytes], Iterable[bytes]]) -> Go2Robot:
    """Return a driver in front of a robot all of whose states are changed."""
    wire = Wire()
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else [payload]
    return wire.robot


class TestGo2Robot(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        wire, silent = Wire(), Wire()
        silent.device.talks = False
        return RobotBench(
            robot=wire.robot,
            foreign=scripted(lambda payload: [payload + bytes(100)]),
            newer=scripted(flip),
            silent=silent.robot,
            unplug=wire.topics.unplug,
            corrupt=lambda: wire.tamper_once(flip),
            greets=False,
        )


# Connecting.


def test_connecting_sends_nothing_and_learns_of_battery_and_firmware() -> None:
    """Whoever only looks, changes nothing."""
    wire = Wire()
    wire.robot.connect()
    assert wire.robot.info is not None
    assert (wire.robot.info.battery, wire.robot.info.voltage) == (0.77, 30.5)
    assert (wire.robot.info.serial, wire.robot.info.version) == ((1, 2), (3, 4))
    assert wire.device.heard == [] and wire.device.requests == []
    assert wire.robot.fileno() == -1


def test_another_robot_type_is_named_by_its_length() -> None:
    """A G1's states are longer: both lengths are in the message."""
    with pytest.raises(WrongDeviceError, match=r"1280 bytes.*1180.*G1"):
        scripted(lambda payload: [payload + bytes(100)]).connect()


def test_a_c_struct_is_named_as_such() -> None:
    """The right length, no CDR header."""
    with pytest.raises(WrongDeviceError, match="C struct"):
        scripted(lambda payload: [payload[4:] + bytes(4)]).connect()


def test_silence_comes_with_advice() -> None:
    """Cable, interface, firewall, bridge; and who discovery sees."""
    wire = Wire()
    wire.device.talks = False
    wire.topics.others = {topics.LOW_STATE: ("Cyclone DDS 01ab",)}
    with pytest.raises(TransportTimeoutError, match=r"Cyclone DDS 01ab.*192\.168\.123.*firewall.*bridge"):
        wire.robot.connect()


def test_a_standing_clock_is_no_robot() -> None:
    """States whose tick never moves are no sign of life."""
    wire = Wire()
    wire.device.tick_step = 0
    with pytest.raises(TransportTimeoutError, match="stands still at 1000 ms"):
        wire.robot.connect()


def test_a_failed_connect_closes_the_transport() -> None:
    """Another attempt starts afresh."""
    wire = Wire()
    wire.device.talks = False
    with pytest.raises(TransportTimeoutError):
        wire.robot.connect()
    with pytest.raises(TransportLostError, match="not open"):
        wire.topics.receive(0.0)
    wire.device.talks = True
    wire.robot.connect()
    assert wire.robot.link_errors == 0


def test_nothing_works_before_connecting() -> None:
    """Each says what is missing."""
    robot = Wire().robot
    for call in (lambda: robot.home(1.0), lambda: robot.arm(1.0)):
        with pytest.raises(SafetyError, match="connect"):
            call()
    with pytest.raises(TransportError):
        robot.passive()


# Sport mode.


def apis(wire: Wire) -> list[tuple[str, int]]:
    """Return what was asked of the robot."""
    return [(service, request.api) for service, request in wire.device.requests]


def test_a_lying_robot_is_released_without_being_laid_down() -> None:
    """Check, release, check again; no command goes out."""
    wire = Wire()
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire) == [("motion_switcher", 1001), ("motion_switcher", 1003), ("motion_switcher", 1001)]
    assert wire.device.mode == "" and wire.device.heard == []
    assert Status.HOMED in wire.robot.read_state(1.0).status


def test_a_standing_robot_is_laid_down_first() -> None:
    """A robot that is released while it stands falls."""
    wire = Wire(pose=STANDING)
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire)[:3] == [("motion_switcher", 1001), ("sport", 1005), ("motion_switcher", 1003)]


def test_a_robot_that_stays_standing_is_not_released() -> None:
    """It would fall; nothing was commanded, so nothing is damped at the end either."""
    wire = Wire(pose=STANDING)
    wire.device.codes = {("sport", 1005): [4201]}
    wire.robot.connect()
    with pytest.raises(SafetyError, match="did not lay the robot down"):
        wire.robot.home(10.0)
    assert ("motion_switcher", 1003) not in apis(wire) and wire.device.mode == "normal"
    assert make_passive(wire.robot, wire.clock)
    assert wire.device.heard == []


def test_a_hung_robot_is_released_as_it_hangs() -> None:
    """Its base is held: it cannot fall."""
    wire = Wire(Go2HungRobot, pose=STANDING)
    wire.robot.connect()
    wire.robot.home(10.0)
    assert ("sport", 1005) not in apis(wire) and wire.device.mode == ""


def test_a_busy_switcher_is_asked_again() -> None:
    """To release, too; the look that follows tells whether it did."""
    wire = Wire()
    wire.device.codes = {("motion_switcher", 1003): [7002]}
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire).count(("motion_switcher", 1003)) == 2 and wire.device.mode == ""


def test_a_mode_that_does_not_come_back_is_an_error() -> None:
    """The operator still has the remote."""
    wire = Wire()
    robot = wire.armed()
    robot.passive()
    wire.device.stubborn = True
    with pytest.raises(TransportTimeoutError, match=r"'normal' did not take the robot.*remote"):
        robot.hand_back(2.0)


def test_an_answer_without_a_name_is_not_taken_for_no_mode() -> None:
    """A missing name must not pass for a robot that was released."""
    wire = Wire()
    wire.device._serve = lambda service, request: (0, '{"form":"0"}')  # type: ignore[method-assign]
    wire.robot.connect()
    with pytest.raises(ProtocolError, match="names no mode"):
        wire.robot.home(10.0)


def test_a_robot_without_active_mode_is_left_alone() -> None:
    """Nothing is released, and nothing is handed back."""
    wire = Wire(mode="")
    robot = wire.armed()
    assert apis(wire) == [("motion_switcher", 1001)]
    robot.passive()
    robot.hand_back(5.0)
    assert apis(wire) == [("motion_switcher", 1001)]


def test_the_mode_that_was_released_gets_the_robot_back() -> None:
    """By its own name, after passive only; then nothing more is sent."""
    wire = Wire(mode="mcf")
    robot = wire.armed()
    with pytest.raises(SafetyError, match="passive"):
        robot.hand_back(5.0)
    robot.passive()
    heard = len(wire.device.heard)
    robot.hand_back(5.0)
    assert wire.device.mode == "mcf"
    assert json.loads(wire.device.requests[-2][1].parameter) == {"name": "mcf"}
    robot.repeat()
    assert len(wire.device.heard) == heard
    with pytest.raises(SafetyError, match="home"):
        robot.arm(1.0)


def test_a_mode_that_does_not_let_go_is_an_error() -> None:
    """After the time given, with its name."""
    wire = Wire()
    wire.device.stubborn = True
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match="'normal' did not let go"):
        wire.robot.home(6.0)


def test_older_firmware_is_released_through_the_service_list() -> None:
    """A switcher that is silent for 3 s is not there; the old way back works, too."""
    wire = Wire()
    wire.device.deaf = {"motion_switcher"}
    robot = wire.armed()
    service, request = wire.device.requests[-1]
    assert (service, request.api) == ("robot_state", 1001)
    assert json.loads(request.parameter) == {"name": "sport_mode", "switch": 0}
    robot.passive()
    robot.hand_back(5.0)
    assert json.loads(wire.device.requests[-1][1].parameter) == {"name": "sport_mode", "switch": 1}


def test_a_robot_without_any_service_is_a_timeout_with_advice() -> None:
    """As through a bridge that carries states only."""
    wire = Wire()
    wire.device.deaf = set(topics.SERVICES)
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match=r"3104.*bridge"):
        wire.robot.home(10.0)


def test_a_short_silence_of_the_switcher_is_no_older_firmware() -> None:
    """Where less than 3 s were given, nobody can know."""
    wire = Wire()
    wire.device.deaf = {"motion_switcher"}
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match="motion_switcher did not answer within 1 s"):
        wire.robot.home(1.0)
    assert {service for service, _ in apis(wire)} == {"motion_switcher"}


def test_refusals_are_put_into_words() -> None:
    """An error code is told with what to do; a busy switcher is asked again."""
    wire = Wire()
    wire.device.codes = {("motion_switcher", 1001): [7002, 0], ("motion_switcher", 1003): [7008]}
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"releasing the mode failed.*7008"):
        wire.robot.home(10.0)


def test_answers_to_others_are_not_ours() -> None:
    """Another program's answer on the same topic, and garbage, pass by."""
    wire = Wire(mode="")
    wire.robot.connect()
    other = encode_response(Response(77, 1001, 0, '{"form":"0","name":"ai"}'))
    wire.topics.say(topics.response("motion_switcher"), other)
    wire.topics.say(topics.response("motion_switcher"), b"\x00\x01\x00\x00")
    wire.device.receive = _deaf_to(wire.device, topics.response("motion_switcher"))  # type: ignore[method-assign]
    wire.robot.home(5.0)
    assert wire.device.mode == ""


def _deaf_to(device: ScriptedGo2, topic: str) -> Callable[[str, bytes, int], None]:
    hear = device.receive
    return lambda t, payload, stamp_ns=0: None if t == topic else hear(t, payload, stamp_ns)


# Others who command.


def test_a_foreign_writer_keeps_the_robot_from_being_homed() -> None:
    """Commands that go on after the release are refused, with who writes them."""
    wire = Wire(mode="")
    wire.topics.others = {topics.LOW_COMMAND: ("Cyclone DDS 01cd: process stand on host pc",)}
    wire.robot.connect()
    for i in range(100):
        wire.topics.say(topics.LOW_COMMAND, STIFF, after_s=0.1 * i)
    with pytest.raises(SafetyError, match=r"another program.*process stand"):
        wire.robot.home(4.0)


def test_a_writer_that_is_only_known_is_no_reason() -> None:
    """The robot's own processes keep their writers, silent."""
    wire = Wire(mode="")
    wire.topics.others = {topics.LOW_COMMAND: ("Cyclone DDS 01cd",)}
    assert Status.ARMED in wire.armed().read_state(1.0).status


def test_a_command_between_homing_and_arming_refuses_to_arm() -> None:
    """Half a second must be quiet."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.robot.home(4.0)
    wire.topics.say(topics.LOW_COMMAND, STIFF)
    wire.robot.read_state(0.1)
    wire.robot.read_state(0.1)
    with pytest.raises(SafetyError, match="another program"):
        wire.robot.arm(1.0)


def test_a_command_of_another_while_armed_is_a_fault() -> None:
    """Sport mode that comes back looks like this; a second arming begins anew."""
    wire = Wire(mode="")
    robot = wire.armed()
    assert robot.fault == ""
    wire.topics.say(topics.LOW_COMMAND, STIFF)
    state = [robot.read_state(0.1) for _ in range(3)][-1]
    assert "another program" in robot.fault
    assert Status.FAULT in state.status
    robot.passive()
    robot.home(4.0)
    robot.arm(1.0)
    assert robot.fault == ""


def test_commands_of_the_control_process_do_not_worry_the_supervisor() -> None:
    """A robot object that never armed hears another process command: that is its own child."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.topics.say(topics.LOW_COMMAND, STIFF)
    for _ in range(3):
        wire.robot.read_state(0.1)
    assert wire.robot.fault == ""


# The remote.


def test_the_stop_buttons_are_heard_and_remembered() -> None:
    """L2+B from any state; a touch is enough, and it keeps the robot from being armed until homed again."""
    wire = Wire(mode="")
    robot = wire.armed()
    wire.device.remote = Remote(parse_combination("L2+A"))
    robot.read_state(0.1)
    assert robot.operator_stop == ""
    wire.device.remote = Remote(parse_combination("L2+B"))
    robot.read_state(0.1)
    wire.device.remote = Remote()
    robot.read_state(0.1)
    assert robot.operator_stop == "L2+B was pressed on the remote"
    robot.passive()
    with pytest.raises(SafetyError, match=r"L2\+B"):
        robot.arm(1.0)
    robot.home(4.0)
    robot.arm(1.0)


def test_the_stop_buttons_can_be_chosen() -> None:
    """Other buttons, or none; an unknown one is refused at once."""
    wire = Wire(mode="")
    for text, held, stops in (("R1+X", "R1+X", True), ("R1+X", "L2+B", False), ("", "L2+B", False)):
        robot = Go2Robot(wire.topics, wire.clock, stop_buttons=text)
        wire.device.remote = Remote(parse_combination(held))
        robot.connect()
        robot.read_state(0.1)
        assert bool(robot.operator_stop) == stops
        robot.disconnect()
    with pytest.raises(UnknownNameError):
        Go2Robot(wire.topics, wire.clock, stop_buttons="L3")


def test_body_and_remote_reach_the_state() -> None:
    """Everything a legged robot senses besides its joints, in model order."""
    wire = Wire(mode="")
    wire.device.remote = Remote(3, left_x=0.1, left_y=0.2, right_x=0.3, right_y=0.4)
    wire.robot.connect()
    body = wire.robot.read_state(0.1).body
    assert body is not None
    np.testing.assert_allclose(body.orientation, [1, 0, 0, 0])
    np.testing.assert_allclose(body.angular_velocity, [0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(body.acceleration, [0, 0, 9.81], atol=1e-6)
    assert body.foot_force.tolist() == [1, 2, 3, 4]
    assert body.temperature.tolist() == list(range(30, 42))
    assert body.lost.tolist() == list(range(12))
    assert (body.battery, body.voltage, body.current, body.buttons) == (0.77, 30.5, 2.0, 3)
    np.testing.assert_allclose(body.sticks, [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    wire.device.remote = None
    body = wire.robot.read_state(0.1).body
    assert body is not None and body.buttons == -1 and not body.sticks.any()


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
    wire = Wire(mode="")
    wire.robot.connect()
    wire.robot.read_state(0.1)
    wire.tamper_once(change)
    states = drained(wire.robot, 10)
    assert wire.robot.link_errors == errors
    steps = np.diff([state.device_ns for state in states]) // MS
    assert set(steps.tolist()) <= {2, 4}
    assert np.diff([state.sequence for state in states]).tolist() == (steps // 2).tolist()


def test_an_overtaken_state_is_dropped() -> None:
    """Two states that come in the wrong order: the older one is late, and old news."""
    wire = Wire(mode="")
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
    assert wire.robot.link_errors == 2
    assert (np.diff([state.device_ns for state in states]) > 0).all()


def test_a_clock_that_stops_ends_in_a_timeout_that_says_so() -> None:
    """The robot repeats its last state: none of that is fresh."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.robot.read_state(0.1)
    wire.device.tick_step = 0
    wire.robot.read_state(0.1)
    with pytest.raises(TransportTimeoutError, match="clock stands still"):
        wire.robot.read_state(0.1)
    assert wire.robot.link_errors >= 45


def test_the_clock_may_wrap() -> None:
    """After 49.7 days, 32 bits of milliseconds begin at 0 again."""
    wire = Wire(mode="")
    wire.device.tick_ms = 2**32 - 20
    wire.robot.connect()
    states = drained(wire.robot, 20)
    assert set(np.diff([state.device_ns for state in states]).tolist()) == {2 * MS}
    assert wire.robot.link_errors == 0


def test_a_robot_that_was_restarted_is_lost() -> None:
    """Its clock begins again, and so does sport mode: nobody may go on as if nothing were."""
    wire = Wire(mode="")
    robot = wire.armed()
    wire.device.tick_ms = 0
    with pytest.raises(TransportLostError, match="restarted"):
        drained(robot, 3)
    assert make_passive(robot, wire.clock)


def test_a_state_with_nan_passes() -> None:
    """It is sound as a message; what to do about it is the safety module's decision."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.device.pose[4] = np.nan
    assert np.isnan(drained(wire.robot, 2)[-1].position[4])
    wire.robot.home(5.0)
    wire.robot.arm(1.0)
    assert all(np.isfinite(command.position).all() for _, command in wire.device.heard)


def test_checksums_can_be_left_alone() -> None:
    """For a robot whose firmware makes others."""
    wire = Wire(mode="")
    robot = Go2Robot(wire.topics, wire.clock, check_crc=False)
    wire.topics.tamper = lambda topic, payload: [payload[:-1] + b"\x55"]
    robot.connect()
    assert robot.read_state(0.1).position.shape == (12,)


# Commands.


def test_arming_damps_and_says_so() -> None:
    """The first thing that the motors hear is damping at the measured pose."""
    wire = Wire(mode="")
    robot = wire.armed()
    _, command = wire.device.heard[0]
    assert not command.stiffness.any() and (command.damping == 5.0).all() and (command.mode == 1).all()
    np.testing.assert_allclose(command.position, RESTING, atol=1e-6)
    assert robot.last_sequence == -1
    assert robot.read_state(0.1).status == Status.HOMED | Status.ARMED


def test_a_silent_robot_is_not_armed() -> None:
    """States must follow the first command."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.robot.home(5.0)
    wire.device.talks = False
    with pytest.raises(TransportTimeoutError, match="no new states"):
        wire.robot.arm(0.2)


def test_nothing_is_sent_before_arming() -> None:
    """Neither commands nor repeats."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.robot.repeat()
    with pytest.raises(SafetyError, match="arm"):
        wire.robot.send_command(default_command(wire.robot))
    wire.robot.read_state(0.1)
    assert wire.device.heard == []


def test_a_command_reaches_the_motors_as_it_was() -> None:
    """All five parts, in model order, each with its own numbers; limits are the description's."""
    wire = Wire(mode="")
    robot = wire.armed()
    wish = dataclasses.replace(
        default_command(robot), position_target=np.arange(12) / 7, velocity_target=np.arange(12) / 11,
        stiffness=np.arange(12) + 1.3, damping=np.arange(12) / 13, effort=np.arange(12) / 17,
        effort_limit=np.zeros(12), speed_limit=np.zeros(12),
    )  # fmt: skip
    sent = robot.send_command(wish)
    robot.read_state(0.1)
    _, heard = wire.device.heard[-1]
    for ours, theirs in (
        ("position_target", "position"), ("velocity_target", "velocity"), ("stiffness", "stiffness"),
        ("damping", "damping"), ("effort", "effort"),
    ):  # fmt: skip
        np.testing.assert_array_equal(getattr(sent, ours), getattr(heard, theirs), ours)
        np.testing.assert_allclose(getattr(sent, ours), getattr(wish, ours), rtol=1e-7)
    assert sent.effort_limit.tolist() == list(DRIVEN.effort_limit)
    assert np.isinf(sent.speed_limit).all()


def test_repeats_are_the_same_bytes_and_no_new_command() -> None:
    """500 times a second the drives hear what they heard before; number and age go by the first."""
    wire = Wire(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot, target=0.5))
    drained(robot, 5)
    before = len(wire.device.heard)
    for _ in range(3):
        robot.repeat()
        state = robot.read_state(0.1)
    assert len(wire.device.heard) == before + 3
    np.testing.assert_array_equal(
        wire.device.heard[-1][1].position, wire.device.heard[before - 1][1].position
    )
    assert state.command_sequence == robot.last_sequence == 0
    assert state.command_age_ns >= 14 * MS


def test_a_state_names_the_command_before_it() -> None:
    """Not one that went out when the state was already under way, as it is on a slow link."""
    wire = Wire(mode="")
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


def test_absurd_numbers_are_not_sent() -> None:
    """Finite is not enough: 1e30 rad is nobody's wish."""
    wire = Wire(mode="")
    robot = wire.armed()
    with pytest.raises(SafetyError, match="finite"):
        robot.send_command(default_command(robot, target=1e30))
    assert robot.last_sequence == -1


# Passive.


def test_passive_is_damping_sent_three_times() -> None:
    """The robot holds it for ever, and messages get lost."""
    wire = Wire(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    robot.passive()
    robot.read_state(0.1)
    for _, command in wire.device.heard[-3:]:
        assert not command.stiffness.any() and not command.effort.any() and not command.velocity.any()
        assert (command.damping == 5.0).all()
    sent = robot.send_command(default_command(robot))
    assert not sent.stiffness.any()


def test_passive_is_confirmed_by_efforts_not_by_hope() -> None:
    """A robot that pushes on after 10 ms is still armed; one whose drives brake is not."""
    wire = Wire(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    drained(robot, 5)
    held = wire.device.command
    wire.device.receive = lambda topic, payload, stamp_ns=0: None  # type: ignore[method-assign]
    robot.passive()
    assert all(Status.ARMED in state.status for state in drained(robot, 20))
    del wire.device.receive
    assert held is not None
    # Legs that sink at 2 rad/s are braked with 10 N·m each.
    wire.device.velocity = np.full(12, 2.0)
    robot.passive()
    states = drained(robot, 10)
    armed = [Status.ARMED in state.status for state in states]
    assert armed[:4] == [True] * 4 and armed[-1] is False


def test_make_passive_reports_what_the_robot_shows() -> None:
    """True where the efforts fall, false where they stay."""
    wire = Wire(mode="")
    robot = wire.armed()
    robot.send_command(default_command(robot))
    drained(robot, 5)
    assert make_passive(robot, wire.clock)
    robot.arm(1.0)
    robot.send_command(default_command(robot))
    drained(robot, 5)
    wire.device.receive = lambda topic, payload, stamp_ns=0: None  # type: ignore[method-assign]
    assert not make_passive(robot, wire.clock)


def test_another_process_can_make_it_passive() -> None:
    """The supervisor's own driver, connected long ago, whose queue was left alone, damps within a tick."""
    wire = Wire(mode="")
    wire.robot.connect()
    wire.topics.say(topics.LOW_COMMAND, STIFF, after_s=0.5)
    wire.clock.advance_ns(1_000_000_000)
    assert make_passive(wire.robot, wire.clock)
    command = wire.device.command
    assert command is not None and not command.stiffness.any()


def test_the_hung_robot_is_another_description() -> None:
    """Same wire; no floor, no tilt limit, the gains of the suspended recording."""
    wire = Wire(Go2HungRobot, mode="")
    robot = wire.armed()
    assert robot.description.name == "go2_hung"
    assert robot.description.floating_base is None
    assert robot.description.limits.legs is not None and np.isinf(robot.description.limits.legs.tilt)
    assert robot.description.stiffness == (20.0,) * 12


def test_recorded_bytes_can_be_decoded_again() -> None:
    """Raw messages of both directions, as they were on the wire."""
    wire = Wire(mode="")
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


def test_a_changed_layout_asks_for_an_update() -> None:
    """States of the right length without one right checksum."""
    with pytest.raises(VersionMismatchError, match=r"checksum.*update deal-hw"):
        scripted(flip).connect()
