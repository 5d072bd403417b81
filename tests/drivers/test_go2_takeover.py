"""Taking the Go2 over: sport mode lets go, nobody else commands, and the operator's remote."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes.go2 import RESTING, STANDING, STIFF, FakeBench

from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.remote import Remote, parse_combination
from deal_hw.drivers.unitree.rpc import Request, Response, encode_note, encode_response
from deal_hw.errors import (
    ProtocolError,
    SafetyError,
    TransportLostError,
    TransportTimeoutError,
    UnknownNameError,
)
from deal_hw.transport import Message
from deal_hw.types import Status

# Sport mode.


def apis(wire: FakeBench) -> list[tuple[str, int]]:
    """Return what was asked of the robot."""
    return [(service, request.api) for service, request in wire.device.requests]


def test_a_lying_robot_is_released_without_being_laid_down() -> None:
    """Check, release, check again; no command goes out."""
    wire = FakeBench()
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire) == [("motion_switcher", 1001), ("motion_switcher", 1003), ("motion_switcher", 1001)]
    assert wire.device.mode == "" and wire.device.received == []
    assert Status.HOMED in wire.robot.read_state(1.0).status


def test_a_standing_robot_is_laid_down_first() -> None:
    """A robot that is released while it stands falls."""
    wire = FakeBench(pose=STANDING)
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire)[:3] == [("motion_switcher", 1001), ("sport", 1005), ("motion_switcher", 1003)]


def test_a_robot_that_stays_standing_is_not_released() -> None:
    """It would fall; nothing was commanded, so nothing is damped at the end either."""
    wire = FakeBench(pose=STANDING)
    wire.device.codes = {("sport", 1005): [4201]}
    wire.robot.connect()
    with pytest.raises(SafetyError, match="did not lay the robot down"):
        wire.robot.home(10.0)
    assert ("motion_switcher", 1003) not in apis(wire) and wire.device.mode == "normal"
    assert make_passive(wire.robot, wire.clock)
    assert wire.device.received == []


def test_a_robot_that_is_slower_than_real_time_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """An emulator on a busy computer: it lies down within 3 s of its own time, 6 s of ours."""
    wire = FakeBench(pose=STANDING)
    device, serve, asked_ms = wire.device, wire.device.serve, [-1]
    # A state every 2 ms of ours is one every millisecond of its own.
    device.tick_step = 1

    def slowly(service: str, request: Request) -> tuple[int, str]:
        if (service, request.api) != ("sport", 1005):
            return serve(service, request)
        asked_ms[0] = device.tick_ms
        return 0, ""

    def move(topic: str, payload: bytes) -> tuple[bytes]:
        if 0 <= asked_ms[0] < device.tick_ms - 3000:
            device.pose = RESTING.copy()
        return (payload,)

    monkeypatch.setattr(device, "serve", slowly)
    wire.topics.tamper = move
    wire.robot.connect()
    wire.robot.home(20.0)
    assert wire.device.mode == ""


def test_a_robot_on_a_stand_is_released_as_it_is() -> None:
    """Its base is held: it cannot fall."""
    wire = FakeBench(Go2OnStandRobot, pose=STANDING)
    wire.robot.connect()
    wire.robot.home(10.0)
    assert ("sport", 1005) not in apis(wire) and wire.device.mode == ""


def test_a_busy_switcher_is_asked_again() -> None:
    """To release, too; the look that follows tells whether it did."""
    wire = FakeBench()
    wire.device.codes = {("motion_switcher", 1003): [7002]}
    wire.robot.connect()
    wire.robot.home(10.0)
    assert apis(wire).count(("motion_switcher", 1003)) == 2 and wire.device.mode == ""


def test_a_mode_that_does_not_come_back_is_an_error() -> None:
    """The operator still has the remote."""
    wire = FakeBench()
    robot = wire.armed()
    robot.passive()
    wire.device.stubborn = True
    with pytest.raises(TransportTimeoutError, match=r"'normal' did not take the robot.*remote"):
        robot.hand_back(2.0)


def test_an_answer_without_a_name_is_not_taken_for_no_mode() -> None:
    """A missing name must not pass for a robot that was released."""
    wire = FakeBench()
    wire.device.serve = lambda service, request: (0, '{"form":"0"}')  # type: ignore[method-assign]
    wire.robot.connect()
    with pytest.raises(ProtocolError, match="names no mode"):
        wire.robot.home(10.0)


def test_a_robot_without_active_mode_is_left_alone() -> None:
    """Nothing is released, and nothing is handed back."""
    wire = FakeBench(mode="")
    robot = wire.armed()
    assert apis(wire) == [("motion_switcher", 1001)]
    robot.passive()
    robot.hand_back(5.0)
    assert apis(wire) == [("motion_switcher", 1001)]


def test_the_mode_that_was_released_gets_the_robot_back() -> None:
    """By its own name, after passive only; then nothing more is sent."""
    wire = FakeBench(mode="mcf")
    robot = wire.armed()
    with pytest.raises(SafetyError, match="passive"):
        robot.hand_back(5.0)
    robot.passive()
    received = len(wire.device.received)
    robot.hand_back(5.0)
    assert wire.device.mode == "mcf"
    assert json.loads(wire.device.requests[-2][1].parameter) == {"name": "mcf"}
    robot.repeat()
    assert len(wire.device.received) == received
    with pytest.raises(SafetyError, match="home"):
        robot.arm(1.0)


def test_a_mode_that_does_not_let_go_is_an_error() -> None:
    """After the time given, with its name."""
    wire = FakeBench()
    wire.device.stubborn = True
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match="'normal' did not release"):
        wire.robot.home(6.0)


def test_older_firmware_is_released_through_the_service_list() -> None:
    """A switcher that is silent for 3 s is not there; the old way back works, too."""
    wire = FakeBench()
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
    wire = FakeBench()
    wire.device.deaf = set(topics.SERVICES)
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match=r"3104.*bridge"):
        wire.robot.home(10.0)


@pytest.mark.parametrize(
    ("received", "words"),
    [
        ("00000000000000bb", "the certificate may only read"),
        # Where the bridge hears us, or is too old to say whom it hears, the services are what is missing.
        ("00000000000000bb 00000000000000aa", "neither motion_switcher nor robot_state answers"),
        (None, "neither motion_switcher nor robot_state answers"),
    ],
)
def test_a_bridge_that_does_not_hear_us_is_told_from_a_robot_without_services(
    received: str | None, words: str
) -> None:
    """With a certificate that may only read, Zenoh drops requests and tells nobody."""
    wire = FakeBench()
    wire.device.deaf, wire.topics.our_stream = set(topics.SERVICES), 0xAA
    wire.robot.connect()
    reported = {"control": "idle", "reason": "nobody", **({} if received is None else {"heard": received})}
    for i in range(100):
        wire.topics.say(topics.BRIDGE, encode_note(reported), 0.2 * i)
    began_ns = wire.clock.now_ns()
    with pytest.raises(TransportTimeoutError, match=words):
        wire.robot.home(30.0)
    assert (wire.clock.now_ns() - began_ns < 2_000_000_000) == ("read" in words)
    assert wire.device.received == []


def test_a_short_silence_of_the_switcher_is_no_older_firmware() -> None:
    """Where less than 3 s were given, nobody can know."""
    wire = FakeBench()
    wire.device.deaf = {"motion_switcher"}
    wire.robot.connect()
    with pytest.raises(TransportTimeoutError, match="motion_switcher did not answer within 1 s"):
        wire.robot.home(1.0)
    assert {service for service, _ in apis(wire)} == {"motion_switcher"}


def test_refusals_are_put_into_words() -> None:
    """An error code is reported with what to do; a busy switcher is asked again."""
    wire = FakeBench()
    wire.device.codes = {("motion_switcher", 1001): [7002, 0], ("motion_switcher", 1003): [7008]}
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"releasing the mode failed.*7008"):
        wire.robot.home(10.0)


def test_answers_to_others_are_not_ours() -> None:
    """Another program's answer on the same topic, and garbage, pass by."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    other = encode_response(Response(77, 1001, 0, '{"form":"0","name":"ai"}'))
    wire.topics.say(topics.response("motion_switcher"), other)
    wire.topics.say(topics.response("motion_switcher"), b"\x00\x01\x00\x00")
    wire.robot.home(5.0)
    assert wire.device.mode == ""


# Others who command.


def test_a_foreign_writer_keeps_the_robot_from_being_homed() -> None:
    """Commands that go on after the release are refused, with who writes them."""
    wire = FakeBench(mode="")
    wire.topics.others = {topics.LOW_COMMAND: ("Cyclone DDS 01cd: process stand on host pc",)}
    wire.robot.connect()
    for i in range(100):
        wire.topics.say(topics.LOW_COMMAND, STIFF, 0.1 * i)
    with pytest.raises(SafetyError, match=r"another program.*process stand"):
        wire.robot.home(4.0)


def test_a_writer_that_is_only_known_is_no_reason() -> None:
    """The robot's own processes keep their writers, silent."""
    wire = FakeBench(mode="")
    wire.topics.others = {topics.LOW_COMMAND: ("Cyclone DDS 01cd",)}
    assert Status.ARMED in wire.armed().read_state(1.0).status


def test_a_command_between_homing_and_arming_refuses_to_arm() -> None:
    """Half a second must be quiet."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.robot.home(4.0)
    wire.topics.say(topics.LOW_COMMAND, STIFF)
    wire.robot.read_state(0.1)
    wire.robot.read_state(0.1)
    with pytest.raises(SafetyError, match="another program"):
        wire.robot.arm(1.0)


def test_a_command_of_another_while_armed_is_a_fault() -> None:
    """Sport mode that comes back looks like this; a second arming begins anew."""
    wire = FakeBench(mode="")
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
    wire = FakeBench(mode="")
    wire.robot.connect()
    wire.topics.say(topics.LOW_COMMAND, STIFF)
    for _ in range(3):
        wire.robot.read_state(0.1)
    assert wire.robot.fault == ""


# The remote.


def test_the_stop_buttons_are_heard_and_remembered() -> None:
    """L2+B from any state; a touch is enough, and it keeps the robot from being armed until homed again."""
    wire = FakeBench(mode="")
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
    wire = FakeBench(mode="")
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
    wire = FakeBench(mode="")
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


def test_who_takes_over_listens_for_a_short_time() -> None:
    """What the dead run had sent still waits and does not count; a program that goes on commanding does."""
    wire = FakeBench(mode="")
    wire.topics.others = {topics.LOW_COMMAND: ("process walk on host pc",)}
    wire.robot.connect()
    for i in range(10):
        wire.topics.say(topics.LOW_COMMAND, STIFF, 0.002 * i)
    assert wire.robot.other_commander(0.1) == ""
    for i in range(100):
        wire.topics.say(topics.LOW_COMMAND, STIFF, 0.05 * i)
    begin_ns = wire.clock.now_ns()
    assert "another program commands the robot's motors" in (said := wire.robot.other_commander(0.1))
    assert "process walk" in said
    assert wire.clock.now_ns() - begin_ns < 200_000_000
    assert wire.device.requests == [], "no service of the robot is asked"


def test_a_lost_connection_is_made_again_before_others_are_listened_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stopped program loses it; one that stays lost brings nobody's commands."""
    wire = FakeBench(mode="")
    wire.robot.connect()
    receive, lost = wire.topics.receive, [True]

    def receive_or_lose(timeout_s: float) -> Message:
        if lost:
            raise TransportLostError("gone")
        return receive(timeout_s)

    monkeypatch.setattr(wire.topics, "receive", receive_or_lose)
    monkeypatch.setattr(wire.topics, "reopen", lost.clear)
    for i in range(100):
        wire.topics.say(topics.LOW_COMMAND, STIFF, 0.01 * i)
    assert "another program" in wire.robot.other_commander(0.1)
    lost[:] = [True]
    monkeypatch.setattr(wire.topics, "reopen", lambda: receive_or_lose(0.0))
    assert wire.robot.other_commander(0.1) == ""


@pytest.mark.parametrize(
    ("mode", "deaf", "words"),
    [
        ("", False, ""),
        ("", True, ""),
        ("normal", False, "the robot's own controller 'normal' has it"),
        ("normal", True, "another program commands the robot's motors"),
    ],
)
def test_a_robot_is_free_if_nobody_commands_it(mode: str, deaf: bool, words: str) -> None:
    """Then it is damped by the first command; otherwise nothing is sent."""
    bench = FakeBench(mode=mode)
    bench.device.deaf = {"motion_switcher"} if deaf else set()
    bench.robot.connect()
    if words:
        with pytest.raises(SafetyError, match=words):
            bench.robot.require_free(2.0)
        assert bench.device.received == []
        return
    bench.robot.require_free(2.0)
    bench.robot.passive()
    (_, command), *_ = bench.device.received
    assert not command.stiffness.any() and command.damping.all()
