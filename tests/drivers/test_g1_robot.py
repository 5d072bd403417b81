"""The G1's driver on a virtual wire: the robot contract, the crane, mode_machine, guards, damping."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from fakes.g1 import FakeG1Bench

from deal_hw.control.safety.passive import make_passive
from deal_hw.control.safety.safety import CycleInput, Safety
from deal_hw.drivers.g1.description import DESCRIPTION, PASSIVE_DAMPING_NMS_RAD
from deal_hw.drivers.g1.messages import decode_low_command
from deal_hw.drivers.g1.robot import G1Claim, G1Dof23Robot, G1Robot, machine_fault
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.remote import Remote, parse_combination
from deal_hw.errors import SafetyError, VersionMismatchError, WrongDeviceError
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.types import RobotState, Status


def flip(payload: bytes) -> list[bytes]:
    """Change a byte of a joint's position."""
    return [payload[:90] + bytes([payload[90] ^ 0x55]) + payload[91:]]


def faked(change: Callable[[bytes], Iterable[bytes]], kind: type[G1Robot] = G1Robot) -> G1Robot:
    """Return a driver in front of a robot all of whose states are changed."""
    wire = FakeG1Bench(kind)
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else (payload,)
    return wire.robot


class TestG1Robot(RobotSuite):
    kind: type[G1Robot] = G1Robot

    @pytest.fixture
    def bench(self) -> RobotBench:
        wire, silent = FakeG1Bench(self.kind), FakeG1Bench(self.kind)
        silent.device.talks = False
        return RobotBench(
            robot=wire.robot,
            foreign=faked(lambda payload: [payload[:1180]], self.kind),
            newer=faked(flip, self.kind),
            silent=silent.robot,
            unplug=wire.topics.unplug,
            corrupt=lambda: wire.spoil_once(flip),
            greets=False,
        )


class TestG1Dof23Robot(TestG1Robot):
    kind: type[G1Robot] = G1Dof23Robot


# The crane.


def test_without_the_crane_nothing_is_sent() -> None:
    """Nobody confirmed it: neither a request nor a command, and the text says how to confirm."""
    wire = FakeG1Bench(hung=False)
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"crane.*on the floor it would fall.*--hung-on-crane"):
        wire.robot.home(5.0)
    assert wire.device.asked == [] and wire.device.received == []


def test_stopping_needs_no_crane() -> None:
    """Damping is sent whoever asks, once the robot's own controller has let go."""
    wire = FakeG1Bench(hung=False)
    wire.device.mode = ""
    wire.robot.connect()
    wire.robot.require_free(1.0)
    assert make_passive(wire.robot, wire.clock)
    assert wire.device.command is not None and not wire.device.command.stiffness.any()


def test_its_own_controller_is_released_and_not_laid_down() -> None:
    """CheckMode and ReleaseMode of the motion switcher; no StandDown, which a hung robot has no floor for."""
    wire = FakeG1Bench()
    wire.robot.connect()
    wire.robot.home(10.0)
    assert wire.device.mode == "" and set(wire.device.asked) == {1001, 1003}


def test_a_foreign_writer_is_refused_and_named() -> None:
    """Another program commands the motors: nothing is armed, and the remedy is the G1's."""
    wire = FakeG1Bench()
    wire.topics.others = {topics.LOW_COMMAND: ("g1_deploy pid 7",)}
    wire.robot.connect()
    for k in range(4000):
        wire.topics.say(topics.LOW_COMMAND, wire.device._own, 0.005 * k)
    with pytest.raises(SafetyError, match=r"g1_deploy pid 7.*L2 and R2"):
        wire.robot.home(4.0)
    assert wire.device.received.count(wire.device._own) == len(wire.device.received)


# The version.


@pytest.mark.parametrize(
    ("kind", "machine", "words"),
    [
        (G1Robot, 4, "mode_machine 4, a G1 with 23 joints, revision 1.0.*take `g1_23dof`"),
        (G1Dof23Robot, 2, "mode_machine 2, a G1 with 29 joints.*take `g1`"),
        (G1Robot, 6, "waist locked, revision 1.0.*describes only 2 .*5 .*1 .*4 "),
        (G1Robot, 77, "mode_machine 77 .an unknown version"),
    ],
)
def test_another_version_is_refused_with_the_right_robot(
    kind: type[G1Robot], machine: int, words: str
) -> None:
    """By mode_machine, before anything is sent."""
    wire = FakeG1Bench(kind)
    wire.device.machine = machine
    with pytest.raises(WrongDeviceError, match=words):
        wire.robot.connect()
    assert wire.device.received == [] and wire.device.asked == []


@pytest.mark.parametrize("machine", [2, 5])
def test_mode_machine_is_echoed_and_mode_pr_is_0(machine: int) -> None:
    """In every frame, damping included."""
    wire = FakeG1Bench()
    wire.device.machine = machine
    robot = wire.armed()
    robot.send_command(default_command(robot))
    robot.passive()
    robot.read_state(1.0)
    assert robot.info is not None and robot.info.machine == machine
    frames = [decode_low_command(frame, wire.device.joints) for frame in wire.device.received]
    assert len(frames) >= 3
    assert {(frame.mode_machine, frame.mode_pr) for frame in frames} == {(machine, 0)}
    assert all(frame.mode.all() for frame in frames)


def test_every_known_version_has_one_robot() -> None:
    """1, 4: 23 joints; 2, 5: 29; no robot for a locked waist or two arms."""
    fits = {m: [r for r in ("g1", "g1_23dof") if not machine_fault(m, r)] for m in range(10)}
    assert {m: r for m, r in fits.items() if r} == {
        1: ["g1_23dof"],
        2: ["g1"],
        4: ["g1_23dof"],
        5: ["g1"],
    }


def test_a_go2_is_named() -> None:
    """Its states are shorter; the remedy is its robot."""
    with pytest.raises(WrongDeviceError, match=r"1180 bytes.*2092.*`go2`"):
        faked(lambda payload: [payload[:1180]]).connect()


def test_another_checksum_is_another_firmware() -> None:
    """Every state has the right length and none the right checksum."""
    with pytest.raises(VersionMismatchError, match=r"checksum.*update"):
        faked(flip).connect()


# What ends a run.


def ended(change: Callable[[FakeG1Bench], Any]) -> tuple[str, RobotState]:
    """Return the fault after a change while armed, and the first state with it."""
    wire = FakeG1Bench()
    robot = wire.armed()
    assert robot.fault == ""
    change(wire)
    state = robot.read_state(1.0)
    for _ in range(50):
        if robot.fault:
            break
        state = robot.read_state(1.0)
    return robot.fault, state


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("error", 0x41, "'left_knee_joint' reports error 0x41"),
        ("winding", 121, "winding of the motor of joint 'left_knee_joint' is at 121 °C, at most 120"),
    ],
)
def test_a_motor_ends_the_run(field: str, value: int, words: str) -> None:
    """An error code, a winding above 120 degrees; at 120 nothing happens."""
    values = np.zeros(29, np.int64)
    values[DESCRIPTION.joint_names.index("left_knee_joint")] = value

    def change(wire: FakeG1Bench) -> None:
        wire.device.changes[field] = values

    fault, state = ended(change)
    assert words in fault and Status.FAULT in state.status
    if field == "winding":
        values = np.minimum(values, 120)
        assert ended(change)[0] == ""


def test_a_motor_error_refuses_to_begin() -> None:
    """It is there before: home ends with the joint's name."""
    wire = FakeG1Bench()
    wire.device.changes["error"] = np.eye(29, dtype=np.int64)[3]
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"left_knee_joint.*0x1"):
        wire.robot.home(10.0)


def test_another_mode_machine_meanwhile_ends_the_run() -> None:
    """The states come from another robot, or it was switched."""
    fault, _ = ended(lambda wire: setattr(wire.device, "machine", 4))
    assert "mode_machine 4" in fault


def test_the_remotes_buttons_end_the_run() -> None:
    """L2 and B held together, as on a Go2."""
    wire = FakeG1Bench()
    robot = wire.armed()
    wire.device.remote = Remote(parse_combination("L2+B"))
    robot.read_state(1.0)
    robot.read_state(1.0)
    assert "L2+B" in robot.operator_stop


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"casing": np.full(29, 86)}, "motor_temperature"),
        ({"orientation": np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])}, "tilt"),
        ({"angular_velocity": np.array([0.0, 6.1, 0.0])}, "tumble"),
        ({"velocity": np.full(29, 10.1)}, "velocity"),
        ({}, ""),
    ],
)
def test_the_safety_filter_knows_its_limits(changes: dict[str, Any], flag: str) -> None:
    """Casing 85 degrees, tilt 0.35 rad, 6 rad/s of the pelvis, 10 rad/s of a joint; else it arms."""
    wire = FakeG1Bench()
    wire.device.changes = changes
    wire.robot.connect()
    state = wire.robot.read_state(1.0)
    safety = Safety(DESCRIPTION)
    cycle = CycleInput(now_ns=wire.clock.now_ns(), state=state)
    if flag:
        with pytest.raises(SafetyError):
            safety.arm(cycle)
        assert flag in safety.step(cycle, None).flags
    else:
        safety.arm(cycle)
        assert safety.step(cycle, None).flags == ()


# Damping.


def test_every_end_is_damping() -> None:
    """Passive: kp 0, no effort, kd 3 at each of the 29 motors, three copies; the robot confirms it."""
    wire = FakeG1Bench()
    robot = wire.armed()
    robot.send_command(default_command(robot, 0.1))
    before = len(wire.device.received)
    assert make_passive(robot, wire.clock)
    last = [decode_low_command(frame, wire.device.joints) for frame in wire.device.received[before:]]
    assert len(last) >= 3
    for command in last:
        assert not command.stiffness.any() and not command.effort.any() and not command.velocity.any()
        np.testing.assert_array_equal(command.damping, PASSIVE_DAMPING_NMS_RAD)


def test_the_words_say_that_it_would_fall_and_does_not_walk() -> None:
    """Before a run: the crane, the sinking, what still stops it."""
    assert "on the floor it would fall" in G1Robot.condition and "crane" in G1Robot.condition
    for words in ("does not walk", "sink", "holds its last command", "L2 and R2"):
        assert words in G1Robot.notice
    assert G1Claim.robot == "g1"
    assert not DESCRIPTION.rest_position
