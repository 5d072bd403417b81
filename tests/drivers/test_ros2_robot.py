"""A robot of ros2_control: the contract, joints by name, ends of runs, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ros2_rig import COMMANDS, Ros2Rig, Topics, changed, with_

from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleRecord
from deal_hw.drivers.ros2.connect import ros2_robot
from deal_hw.drivers.ros2.device import EPOCH_NS
from deal_hw.drivers.ros2.faults import ControllerFaults
from deal_hw.drivers.ros2.messages import (
    JointStates,
    TrajectoryPoint,
    decode_point,
    decode_positions,
    encode_point,
    encode_positions,
)
from deal_hw.drivers.transports.listen_only import listen_only
from deal_hw.errors import (
    ConfigurationError,
    SafetyError,
)
from deal_hw.testing.faults import OneBadFrame
from deal_hw.testing.joint_faults import JointFaults
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.transport import Message, TopicEnd
from deal_hw.types import NOT_FOLLOWING, FloatArray, Status
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

CDR_KIND = 1
"""The byte of the CDR header that says how numbers are written."""


class _Suite(RobotSuite):
    command = ""

    @pytest.fixture
    def bench(self, tmp_path: Path) -> RobotBench:
        fault = OneBadFrame(CDR_KIND)
        rig = Ros2Rig(tmp_path, self.command, lambda inner: Topics(inner, received=fault))
        foreign = Ros2Rig(
            tmp_path, self.command, device_section={"names": {"elbow": "a_joint", "shoulder": "b_joint"}}
        )
        newer, silent = (Ros2Rig(tmp_path, self.command) for _ in range(2))
        newer.know(state_hash="RIHS01_" + "0" * 64)
        silent.device.freeze(0.0)
        silent.device.tick()
        return RobotBench(
            robot=rig.robot,
            foreign=foreign.robot,
            newer=newer.robot,
            silent=silent.robot,
            unplug=rig.virtual.unplug,
            corrupt=fault.corrupt_next,
            greets=False,
        )


class TestPositions(_Suite):
    command = "position"


class TestTrajectories(_Suite):
    command = "trajectory"


@pytest.fixture(params=COMMANDS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Ros2Rig:
    """A robot with either controller."""
    return Ros2Rig(tmp_path, request.param)


def test_joints_are_found_by_name(rig: Ros2Rig) -> None:
    """States come in another order than the joints', commands go out in the controller's order."""
    rig.armed()
    command = default_command(rig.robot)
    command.position_target[:] = (0.3, -0.4)
    for _ in range(60):
        rig.robot.send_command(command)
        states = rig.pass_time(0.02)
    np.testing.assert_allclose(rig.true_position(), (0.3, -0.4), atol=0.05)
    np.testing.assert_allclose(states[-1].position, rig.true_position(), atol=0.01)
    payload = [message.payload for message in rig.robot.take_wire() if message.channel == "tx"][-1]
    if rig.section.command == "trajectory":
        point = decode_point(payload)
        assert point.names == ("elbow_joint", "shoulder") and point.after_s == 0.02
        np.testing.assert_array_equal(point.position, (-0.4, 0.3))
    else:
        np.testing.assert_array_equal(decode_positions(payload), (-0.4, 0.3))


def test_states_have_the_robots_time(rig: Ros2Rig) -> None:
    """Stamps count from 1970, this computer's clock from zero; they are never mixed."""
    rig.robot.connect()
    states = rig.pass_time(0.5)
    assert all(state.device_ns > EPOCH_NS and state.receive_ns < 10**10 for state in states)
    assert set(np.diff([state.device_ns for state in states])) == {10_000_000}
    assert set(np.diff([state.sequence for state in states])) == {1}


def test_the_order_of_names_may_change(tmp_path: Path) -> None:
    """Each message is read by its own names; others' joints on the topic are left out."""
    count = [0]

    def turn(states: JointStates) -> JointStates:
        count[0] += 1
        if count[0] % 3 == 0:
            return with_(states, names=("gripper",), position=np.ones(1), velocity=[], effort=[])
        order = [0, 1] if count[0] % 2 else [1, 0]
        return with_(
            states,
            names=(*(states.names[i] for i in order), "wheel"),
            position=np.append(states.position[order], 9.0),
            velocity=np.append(states.velocity[order], np.nan),
            effort=np.append(states.effort[order], 9.0),
        )

    rig = changed(tmp_path, turn)
    rig.device.place(np.array([0.2, -0.2]))
    rig.robot.connect()
    for state in rig.pass_time(0.3):
        np.testing.assert_allclose(state.position, rig.true_position(), atol=0.02)
    # One of three states was the gripper's, and so this robot's was lost.
    assert rig.robot.transport_errors in (9, 10, 11)


@pytest.mark.parametrize("missing", ["empty", "nan"])
def test_a_velocity_that_is_not_reported_is_a_difference(tmp_path: Path, missing: str) -> None:
    """Over one control period of 20 ms; an effort is then 0, and connect says so."""

    def strip(states: JointStates) -> JointStates:
        none = np.empty(0) if missing == "empty" else np.full(len(states.names), np.nan)
        return with_(states, velocity=none, effort=none)

    rig = changed(tmp_path, strip)
    rig.armed()
    assert rig.robot.info is not None and rig.robot.info.not_reported == "effort, velocity"
    states = []
    for step in range(25):
        rig.robot.send_command(default_command(rig.robot, 0.02 * step))
        states += rig.pass_time(0.02)
    assert all((state.effort == 0).all() for state in states)
    # The targets move at 0.02 rad in 20 ms, so 1 rad/s.
    for earlier, later in zip(states[:-2], states[2:], strict=True):
        np.testing.assert_allclose(later.velocity, (later.position - earlier.position) / 0.02, atol=1e-6)
    np.testing.assert_allclose(states[-1].velocity, 1.0, atol=0.4)


# The start pose.


def test_home_moves_slowly_from_where_the_robot_is(rig: Ros2Rig) -> None:
    """It starts at the measured pose; no target moves faster than 0.5 rad/s."""
    rig.device.place(np.array([0.8, -0.6]))
    rig.robot.connect()
    rig.robot.home(20.0)
    np.testing.assert_allclose(rig.true_position(), 0.0, atol=0.1)
    decode = (lambda data: decode_point(data).position) if rig.section.command == "trajectory" else None
    sent = [m.payload for m in rig.robot.take_wire() if m.channel == "tx"]
    targets = np.array([(decode or decode_positions)(payload)[::-1] for payload in sent])
    np.testing.assert_allclose(targets[0], (0.8, -0.6), atol=0.03)
    assert np.abs(np.diff(targets, axis=0)).max() <= 0.5 * 0.02 + 1e-9


def test_a_controller_that_ignores_commands_is_named(rig: Ros2Rig) -> None:
    """It subscribes to commands but is not active: no joint follows, and nothing else is tried."""
    rig.device.active = False
    rig.device.place(np.array([0.5, 0.5]))
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"did not follow.*switch_controllers --activate forward_position"):
        rig.robot.home(20.0)
    np.testing.assert_allclose(rig.true_position(), 0.5, atol=0.1)


def test_exchanged_joints_are_found_by_a_small_motion(tmp_path: Path) -> None:
    """The controller has the joints in another order than robot.yaml says."""
    rig = Ros2Rig(tmp_path, device_section={"joints": ("shoulder", "elbow")})
    rig.robot.connect()
    with pytest.raises(
        SafetyError, match=r"(elbow|shoulder) was sent a little way, and (elbow|shoulder) mov"
    ):
        rig.robot.home(20.0)
    assert np.abs(rig.true_position()).max() < 0.15


def test_exchanged_joints_far_apart_stop_at_once(tmp_path: Path) -> None:
    """The first command, which holds the measured pose, already moves them: the pose is watched."""
    rig = Ros2Rig(tmp_path, device_section={"joints": ("shoulder", "elbow")})
    rig.device.place(np.array([0.9, -0.3]))
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"'shoulder' does not follow: .*'elbow'.* exchanged.* `joints` in"):
        rig.robot.home(20.0)


def test_a_joint_outside_its_range_is_not_moved(tmp_path: Path) -> None:
    """The range is -1.5 to 1.5, with a quarter of it beyond each end before a run trips: 2.25."""
    rig = changed(tmp_path, lambda states: with_(states, position=states.position + 2.4))
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"joint shoulder is at 2\.\d+ rad, outside -2\.25 to 2\.25"):
        rig.robot.home(20.0)
    assert rig.device.accepted == 0


def test_no_controller_no_command(rig: Ros2Rig) -> None:
    """Nobody subscribes to the commands: refused with what loads the controller."""
    rig.know(controller=False)
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"nobody subscribes to /forward_position_controller/.*load_contr"):
        rig.robot.home(20.0)
    assert rig.device.accepted == 0


def test_namespace_is_in_topics_and_remedies(tmp_path: Path) -> None:
    """/left/joint_states, /left/forward_position_controller/commands, -c /left/controller_manager."""
    rig = Ros2Rig(tmp_path, namespace="/left")
    rig.armed()
    assert rig.robot.info is not None
    assert rig.robot.info.commands == "/left/forward_position_controller/commands"
    rig.know(controller=False)
    rig.pass_time(0.3)
    assert "-c /left/controller_manager" in rig.robot.fault


# Other programs on the topics.

OTHER = TopicEnd(who="node /teleop", writes=True)
OURS = TopicEnd(who="deal-hw's supervisor", writes=True, ours=True)


def test_a_second_publisher_is_refused(rig: Ros2Rig) -> None:
    """It is named, and nothing is sent; our own processes on this computer do not count."""
    rig.know(commands=(OURS, OTHER))
    rig.robot.connect()
    with pytest.raises(SafetyError, match=r"another program publishes on /forward.*node /teleop"):
        rig.robot.home(20.0)
    assert rig.device.accepted == 0
    rig.know(commands=(OURS,))
    rig.robot.home(20.0)


def test_a_second_publisher_ends_a_run(rig: Ros2Rig) -> None:
    """It appears while the robot is armed: a fault within 0.3 s, before it sends anything."""
    rig.armed()
    assert rig.robot.fault == ""
    rig.know(commands=(OTHER,))
    rig.run(15)
    assert "node /teleop" in rig.robot.fault
    assert rig.robot.read_state(1.0).status & Status.FAULT


def test_commands_of_others_end_a_run_at_once(rig: Ros2Rig) -> None:
    """Without discovery, their messages are noticed; then our passive command is sent once, not again."""
    rig.virtual.discovered = None
    rig.armed()
    foreign = encode_positions(np.zeros(2))
    if rig.section.command == "trajectory":
        foreign = encode_point(TrajectoryPoint(("elbow_joint", "shoulder"), np.zeros(2), 0.1))
    rig.virtual.publish(rig.topics.commands, foreign)
    rig.pass_time(0.02)
    assert "another program publishes" in rig.robot.fault
    rig.robot.take_wire()
    for _ in range(3):
        rig.virtual.publish(rig.topics.commands, foreign)
        rig.robot.passive()
        assert rig.robot.read_state(1.0).status & Status.ARMED
    assert [message.channel for message in rig.robot.take_wire()].count("tx") == 1


def test_before_a_command_others_are_heard(rig: Ros2Rig) -> None:
    """require_free listens for half a second; then a stop of somebody else's robot is refused."""
    rig.virtual.discovered = None
    rig.robot.connect()
    receive, due_ns = rig.virtual.receive, rig.clock.now_ns() + 300_000_000

    def receive_or_publish(timeout_s: float) -> Message:
        nonlocal due_ns
        if rig.clock.now_ns() >= due_ns:
            due_ns += 1_000_000_000
            rig.virtual.publish(rig.topics.commands, encode_positions(np.zeros(2)))
        return receive(min(timeout_s, 0.1))

    rig.virtual.receive = receive_or_publish  # type: ignore[method-assign]
    with pytest.raises(SafetyError, match="another program publishes"):
        rig.robot.require_free(1.0)


def test_who_takes_over_listens_for_a_short_time(rig: Ros2Rig) -> None:
    """Commands of another program, and one that discovery shows."""
    rig.virtual.discovered = None
    rig.robot.connect()
    assert rig.robot.other_commander(0.1) == ""
    receive, due_ns = rig.virtual.receive, rig.clock.now_ns()

    def receive_and_publish(timeout_s: float) -> Message:
        nonlocal due_ns
        if rig.clock.now_ns() >= due_ns:
            due_ns += 50_000_000
            rig.virtual.publish(rig.topics.commands, encode_positions(np.zeros(2)))
        return receive(min(timeout_s, 0.05))

    rig.virtual.receive = receive_and_publish  # type: ignore[method-assign]
    assert "another program publishes" in rig.robot.other_commander(0.1)
    rig.virtual.receive = receive  # type: ignore[method-assign]
    assert rig.robot.other_commander(0.1) == ""
    rig.know(commands=(TopicEnd(who="process teleop", writes=True),))
    assert "process teleop" in rig.robot.other_commander(0.1)


# Ends.


def test_passive_holds_the_measured_pose(rig: Ros2Rig) -> None:
    """The same pose at every repetition, though the arm sags a little; then the joints stand."""
    rig.armed()
    rig.run(60, target=0.7)
    at = rig.true_position()
    assert make_passive(rig.robot, rig.clock)
    sent = [message.payload for message in rig.robot.take_wire() if message.channel == "tx"][-3:]
    assert len(set(sent)) == 1
    rig.pass_time(2.0)
    np.testing.assert_allclose(rig.true_position(), at, atol=0.1)


def test_passive_while_moving_is_confirmed_when_it_stands(rig: Ros2Rig) -> None:
    """States of moving joints confirm nothing."""
    rig.armed()
    rig.run(6, target=1.2)
    moving = rig.pass_time(0.02)[-1]
    assert np.abs(moving.velocity).max() > 0.5
    rig.robot.passive()
    first = rig.robot.read_state(1.0)
    assert first.status & Status.ARMED
    assert make_passive(rig.robot, rig.clock)
    assert np.abs(rig.pass_time(0.02)[-1].velocity).max() < 0.15


def test_without_a_fresh_state_the_last_target_stays(rig: Ros2Rig) -> None:
    """The connection was lost on the way: an old pose would make the robot jump back."""
    rig.armed()
    rig.run(6, target=0.6)
    rig.device.freeze(0.0)
    rig.pass_time(0.1)
    rig.clock.advance_ns(500_000_000)
    rig.robot.passive()
    payload = [message.payload for message in rig.robot.take_wire() if message.channel == "tx"][-1]
    sent = (
        decode_point(payload).position if rig.section.command == "trajectory" else decode_positions(payload)
    )
    np.testing.assert_array_equal(sent, 0.6)


def test_a_run_that_never_commanded_sends_nothing(rig: Ros2Rig) -> None:
    """Its home was refused: the robot is somebody else's."""
    rig.know(commands=(OTHER,))
    rig.robot.connect()
    with pytest.raises(SafetyError):
        rig.robot.home(20.0)
    rig.robot.passive()
    assert rig.device.accepted == 0


def test_what_an_operator_is_told() -> None:
    """There is no watchdog, and no torque-off."""
    from deal_hw.drivers.ros2.robot import Ros2ControlRobot

    assert Ros2ControlRobot.watchdog_s == 0
    assert "emergency stop" in Ros2ControlRobot.stopped_by


def test_a_dry_run_listens_only(tmp_path: Path) -> None:
    """No publisher is declared, and none can send."""
    rig = Ros2Rig(tmp_path, wrap=lambda inner: listen_only(inner))
    rig.robot.connect()
    assert len(rig.pass_time(0.2)) >= 19
    with pytest.raises(SafetyError, match="only listens"):
        rig.robot.passive()


def test_no_descriptor_is_inherited(tmp_path: Path) -> None:
    """Each process opens its own path."""
    rig = Ros2Rig(tmp_path)
    with pytest.raises(ConfigurationError, match="no descriptor"):
        ros2_robot(rig.section, rig.description, "dds", "lo", rig.clock, fd=3)


# The emulated controller.


def test_the_emulated_controller_refuses_what_a_real_one_does(rig: Ros2Rig) -> None:
    """Wrong lengths, values that are not finite, other names and bytes: counted, never applied."""
    bad = [b"", encode_positions(np.ones(3)), encode_positions(np.array([np.nan, 0.0]))]
    if rig.section.command == "trajectory":
        names = ("elbow_joint", "shoulder")
        bad = [
            encode_point(TrajectoryPoint(("a", "b"), np.ones(2), 0.1)),
            encode_point(TrajectoryPoint(names, np.array([np.inf, 0.0]), 0.1)),
        ]
    for payload in bad:
        rig.device.receive(rig.topics.commands, payload)
    rig.device.advance_to(500_000_000)
    assert rig.device.report()["commands_refused"] == len(bad)
    np.testing.assert_allclose(rig.true_position(), 0.0, atol=0.05)


def test_the_log_says_whether_the_robot_is_moved_or_held(rig: Ros2Rig) -> None:
    """By the newest two commands, so that a measurement sees when a run has ended."""
    rig.armed()
    for target in (0.1, 0.2, 0.2, 0.2, 0.3):
        rig.run(1, target)
    assert make_passive(rig.robot, rig.clock)
    words = [what for _, _, what in rig.device.changes]
    assert words[0] == "first command"
    assert words[-4:] == ["moves", "holds", "moves", "holds"]


def test_a_trajectory_is_a_straight_line(tmp_path: Path) -> None:
    """From the present set-point, in the point's time, from the next update on."""
    rig = Ros2Rig(tmp_path, "trajectory")
    point = TrajectoryPoint(("shoulder", "elbow_joint"), np.array([0.2, 0.4]), 0.1)
    rig.device.receive(rig.topics.commands, encode_point(point))
    seen = {}
    for _ in range(80):
        at_ms = rig.device.device_ns // 1_000_000
        rig.device.tick()
        seen[at_ms] = rig.device.setpoint.copy()
    np.testing.assert_allclose(seen[48], (0.1, 0.2), atol=1e-9)
    np.testing.assert_allclose(seen[98], (0.2, 0.4), atol=1e-9)


def test_a_cut_wire_passes_nothing(rig: Ros2Rig) -> None:
    """In both directions, for its time; the robot goes on meanwhile."""
    rig.armed()
    rig.device.cut(0.3)
    accepted = rig.device.accepted
    rig.run(5)
    assert rig.device.accepted == accepted
    rig.pass_time(0.5)
    rig.run(5)
    assert rig.device.accepted > accepted


# A robot that does not follow, in the middle of a run.

FAULT_S = 2.0
"""When it begins, after the first command of the motion; it lasts 2 s."""


class FaultyRun:
    """A multisine of 6 s in which something fails; the clock goes on after its end.

    Attributes:
        report: How it ended.
        passive_s: From the fault to the first cycle without a command [s].
        kinds: Kinds of the events.
    """

    def __init__(self, rig: Ros2Rig, fault: str, *, silent: bool) -> None:
        self._rig = rig
        self.kinds: set[str] = set()
        self._first_ns = self._begun_ns = self._sent_ns = -1
        self._fault, self._silent = fault, silent
        d = rig.description
        plan = RunPlan(robot="arm", motion="excite", excite="multisine", seconds=6.0, seed=1)
        self.report: LoopReport = ControlLoop(
            rig.robot,
            make_behaviour(plan, d),
            Safety(d),
            rig.clock,
            self._sink,
            LoopConfig(duration_s=6.0),
        ).run()
        self.passive_s = (self._sent_ns - self._begun_ns) * 1e-9

    def _sink(self, record: CycleRecord) -> bool:
        self.kinds |= {event.kind for event in record.events}
        if record.sent is None:
            return True
        self._first_ns = record.start_ns if self._first_ns < 0 else self._first_ns
        self._sent_ns = record.start_ns
        if self._begun_ns < 0 and record.start_ns - self._first_ns >= FAULT_S * 1e9:
            self._begun_ns = record.start_ns
            device = self._rig.device
            device._controller_faults = ControllerFaults(silent_manager=self._silent)
            if self._fault == "controller":
                device.active = False
            else:
                begun = {
                    "limp": JointFaults(limp_after_s=0.0),
                    "held": JointFaults(held_after_s=0.0),
                }
                device.joint_faults.give(begun[self._fault], device.device_ns)
        return True

    def speeds(self, seconds: float) -> FloatArray:
        """Let time pass, and return the joints' largest true speeds in it [rad/s]."""
        device, before, fastest = self._rig.device, self._rig.true_position(), 0.0
        for _ in range(round(seconds / 0.01)):
            device.advance_to(device.device_ns + 10_000_000)
            now = self._rig.true_position()
            fastest = max(fastest, float(np.abs(now - before).max()) / 0.01)
            before = now
        return np.array(fastest)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("fault", ["controller", "limp", "held"])
def test_a_robot_that_does_not_follow_is_passive_and_does_not_jump_when_it_does_again(
    tmp_path: Path, fault: str, command: str
) -> None:
    """Nothing on the wire says so: it is seen in the motion, in less than the 2 s that the fault lasts."""
    rig = Ros2Rig(tmp_path, command)
    run = FaultyRun(rig, fault, silent=True)
    assert run.report.outcome is Outcome.TRIPPED and run.report.flags == ("not_following",)
    assert run.passive_s < 2.0 and NOT_FOLLOWING in run.kinds
    assert run.report.passive_confirmed
    run.speeds(2.0 - run.passive_s)
    rig.device.active = True
    assert run.speeds(1.0) < 0.5
    # The next run begins where the robot is, at the speed of homing.
    rig.robot.connect()
    begun_ns, at = rig.clock.now_ns(), rig.true_position()
    rig.robot.home(20.0)
    passed_s = (rig.clock.now_ns() - begun_ns) * 1e-9
    assert np.abs(rig.true_position() - at).max() <= 0.5 * passed_s


@pytest.mark.parametrize("command", COMMANDS)
def test_the_controller_managers_word_ends_a_run_at_once(tmp_path: Path, command: str) -> None:
    """Since ROS 2 Jazzy it says which controllers are active: the next cycle is passive."""
    run = FaultyRun(Ros2Rig(tmp_path, command), "controller", silent=False)
    assert run.report.flags == ("device_fault",)
    assert "says that forward_position_controller is inactive: it takes no commands" in run.report.reason
    assert run.passive_s <= 0.04


def test_an_inactive_controller_is_refused_before_any_command(rig: Ros2Rig) -> None:
    """And named with the command that activates it."""
    rig.robot.connect()
    rig.device.active = False
    with pytest.raises(SafetyError, match=r"is inactive.*switch_controllers --activate forward_position"):
        rig.robot.home(20.0)
    assert rig.device.accepted == 0


def test_a_passive_robot_that_was_moved_is_held_where_it_is(rig: Ros2Rig) -> None:
    """Its drives were off, and somebody moved it by 1 rad: it is not brought back."""
    rig.armed()
    rig.run(20)
    rig.robot.passive()
    rig.pass_time(0.1)
    rig.device.place(np.array([1.0, -0.8]))
    rig.pass_time(0.05)
    rig.robot.passive()
    rig.pass_time(1.0)
    np.testing.assert_allclose(rig.true_position(), (1.0, -0.8), atol=0.1)


def test_an_activity_message_that_is_none_counts_as_an_error(rig: Ros2Rig) -> None:
    """A run goes on: nothing is known of the controller."""
    robot = rig.armed()
    before = robot.transport_errors
    rig.virtual.publish(rig.topics.activity, b"\x00\x01\x00\x00" + bytes(7))
    rig.run(5)
    assert robot.transport_errors > before and robot.fault == ""
