"""The H1 on a crane: model, wire, crane, damping, faults, the emulator's truth, runs in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.go2 import FakeTopics, TopicBench
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.control.safety.safety import CycleInput, Safety
from deal_hw.drivers.b2.doctor import B2Doctor
from deal_hw.drivers.b2.emulator import B2Truth
from deal_hw.drivers.b2.robot import B2Robot
from deal_hw.drivers.go2.doctor import Go2Doctor
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.h1 import description as facts
from deal_hw.drivers.h1.description import DESCRIPTION, SPACES
from deal_hw.drivers.h1.doctor import H1Doctor
from deal_hw.drivers.h1.emulator import H1Device, H1Truth
from deal_hw.drivers.h1.faults import H1FaultPlan
from deal_hw.drivers.h1.joints import JOINTS, MOTORS, ORDER, SERVO_MODE, TORSO, UNUSED, WEAK
from deal_hw.drivers.h1.messages import H1StateDecoder, pelvis_motion
from deal_hw.drivers.h1.robot import H1Claim, H1Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.emulated_quadruped import QuadrupedTruth
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.drivers.unitree.go_messages.low_command import (
    GoCommand,
    GoCommandEncoder,
    decode_low_command,
)
from deal_hw.drivers.unitree.humanoid import part_of, per_joint
from deal_hw.errors import ConfigurationError, SafetyError, UnknownNameError, WrongDeviceError
from deal_hw.findings import Severity
from deal_hw.robots import robot_entry
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command, run_cycles
from deal_hw.types import FloatArray, IntArray
from deal_hw.workflows.running.plan import RunPlan, make_behaviour

KNEE = JOINTS.index("left_knee_joint")
COUNT = len(JOINTS)


class H1Bench(TopicBench[H1Robot]):
    """An emulated robot, its driver, and the topics between them; the commands that came."""

    def __init__(self, *, hung: bool = True, **options: Any) -> None:
        self.clock = VirtualClock(5_000_000_000)
        self.device = H1Device(H1Truth.nominal(), **options)
        self.topics = FakeTopics(self.device, self.clock)
        self.robot = H1Robot(self.topics, self.clock, hung_on_crane=hung)
        self.received: list[bytes] = []
        deliver = self.device.receive

        def receive(topic: str, payload: bytes, stamp_ns: int = 0) -> None:
            if topic == topics.LOW_COMMAND:
                self.received.append(payload)
            deliver(topic, payload, stamp_ns)

        self.device.receive = receive  # type: ignore[method-assign]


def flip(payload: bytes) -> list[bytes]:
    """Change a byte of a joint's position."""
    return [payload[:90] + bytes([payload[90] ^ 0x55]) + payload[91:]]


def changed(change: Callable[[bytes], Iterable[bytes]]) -> H1Robot:
    """Return a driver in front of a robot all of whose states are changed."""
    wire = H1Bench()
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else (payload,)
    return wire.robot


class TestH1Robot(RobotSuite):
    @pytest.fixture
    def bench(self) -> RobotBench:
        wire = H1Bench()
        return RobotBench(
            robot=wire.robot,
            foreign=changed(lambda payload: [payload + bytes(100)]),
            newer=changed(flip),
            silent=changed(lambda payload: []),
            unplug=wire.topics.unplug,
            corrupt=lambda: wire.spoil_once(flip),
            greets=False,
        )


# Joints and model.


def test_every_joint_has_one_motor_and_one_slot_is_empty() -> None:
    """The vendor's numbers: 19 joints in 20 slots, 9 unused, ankles and arms weak."""
    assert len(MOTORS) == layout.SLOTS and sorted(MOTORS) == sorted((*JOINTS, UNUSED))
    assert MOTORS.index(UNUSED) == 9 and MOTORS.index("torso_joint") == 6
    assert {MOTORS[0], MOTORS[8], MOTORS[11]} == {
        "right_hip_roll_joint",
        "right_hip_yaw_joint",
        "right_ankle_joint",
    }
    weak = {joint for joint, mode in zip(JOINTS, SERVO_MODE, strict=True) if mode == 0x01}
    assert weak == {MOTORS[motor] for motor in WEAK}
    assert {part_of(joint) for joint in weak} == {"ankle", *(p for p in facts.RANGE_RAD if p[0] in "se")}
    assert robot_entry("h1").motor_joints() == MOTORS


def test_the_model_is_that_of_the_description() -> None:
    """Joints, ranges, efforts, gains and friction, and the vendor's masses."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    assert tuple(model.joint(k).name for k in range(model.njnt)) == JOINTS
    np.testing.assert_allclose(model.jnt_range, facts.joint_ranges())
    order = [model.actuator(joint).id for joint in JOINTS]
    assert [model.actuator(k).name for k in range(model.nu)] == [m for m in MOTORS if m != UNUSED]
    np.testing.assert_allclose(model.actuator_forcerange[order, 1], DESCRIPTION.effort_limit)
    np.testing.assert_allclose(model.actuator_gainprm[order, 0], DESCRIPTION.stiffness)
    damping = np.array(DESCRIPTION.damping) + facts.JOINT_DAMPING_NMS_RAD
    np.testing.assert_allclose(-model.actuator_biasprm[order, 2], damping)
    np.testing.assert_allclose(model.dof_frictionloss, per_joint(facts.FRICTIONLOSS_NM, JOINTS))
    np.testing.assert_allclose(model.dof_armature, facts.ARMATURE_KGM2)
    assert float(model.body_mass.sum()) == pytest.approx(51.65, abs=1e-3)


def test_right_and_left_are_mirrored() -> None:
    """Ranges, default pose and excitation of a joint on the right are those of the left, rolls negated."""
    for left in (name for name in JOINTS if name.startswith("left_")):
        k, m = JOINTS.index(left), JOINTS.index(left.replace("left_", "right_"))
        sign = -1.0 if part_of(left) in facts.MIRRORED else 1.0
        assert DESCRIPTION.default_position[m] == sign * DESCRIPTION.default_position[k]
        for table in (DESCRIPTION.limits.target, DESCRIPTION.excitation_range):
            np.testing.assert_allclose(sorted(sign * np.array(table[k])), table[m])


def test_excitations_keep_links_apart() -> None:
    """Corners of the excitation range and draws in it: left and right, legs and arms stay 3 cm apart."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    data = mujoco.MjData(model)
    low, high = np.array(DESCRIPTION.excitation_range).T
    names = [model.geom(k).name for k in range(model.ngeom)]
    far = [(a, b) for a in range(model.ngeom) for b in range(a) if _are_apart(names[a], names[b])]
    rng = np.random.default_rng(1)
    least = np.inf
    for k in range(150):
        share = rng.integers(0, 2, COUNT) if k % 2 else rng.random(COUNT)
        data.qpos[:] = low + share * (high - low)
        mujoco.mj_kinematics(model, data)
        least = min(least, *(mujoco.mj_geomDistance(model, data, a, b, 0.5, None) for a, b in far))
    assert len(far) > 60 and least > 0.03


def _are_apart(one: str, other: str) -> bool:
    """Return whether two links are on two sides, or one is of a lower arm and the other of no arm."""
    sides = {name.split("_")[0] for name in (one, other)}
    lower = [name for name in (one, other) if "shoulder_yaw" in name or "elbow" in name]
    arms = [name for name in (one, other) if "shoulder" in name or "elbow" in name]
    return sides == {"left", "right"} or (len(lower) == 1 and len(arms) == 1)


# The driver.


def test_without_the_crane_nothing_is_sent() -> None:
    """Nobody confirmed it: neither a request nor a command, and the text says how to confirm."""
    wire = H1Bench(hung=False)
    wire.robot.connect()
    with pytest.raises(SafetyError, match=r"the H1 must hang.*on the floor it would fall.*--hung-on-crane"):
        wire.robot.home(5.0)
    assert wire.received == [] and wire.device.controller_name == "ai"
    assert "H1" in H1Robot.notice and "L2 and R2" in H1Robot.notice and H1Claim.robot == "h1"


def test_every_command_has_each_motors_mode() -> None:
    """Targets and damping: 0x0A at 0 to 8, 0x01 from 10 on; slot 9 has the vendor's stop values, no gains."""
    wire = H1Bench()
    robot = wire.armed()
    robot.send_command(default_command(robot))
    robot.passive()
    robot.read_state(1.0)
    assert len(wire.received) >= 3
    for payload in wire.received:
        modes = np.frombuffer(payload, "u1")[layout.COMMAND_MODE_AT]
        np.testing.assert_array_equal(modes, [0x0A] * 10 + [0x01] * 10)
        spare = np.frombuffer(payload, layout.LOW_COMMAND)[0]["motor"][9]
        assert [float(spare[name]) for name in ("q", "dq", "kp", "kd")] == [2146000000.0, 16000.0, 0.0, 0.0]


def test_every_end_is_damping() -> None:
    """Passive: kp 0, no effort, the vendor's kd; the robot confirms it."""
    wire = H1Bench()
    robot = wire.armed()
    robot.send_command(default_command(robot, 0.1))
    before = len(wire.received)
    assert make_passive(robot, wire.clock)
    last = [decode_low_command(frame, ORDER.motors) for frame in wire.received[before:]]
    assert len(last) >= 3
    for command in last:
        assert not command.stiffness.any() and not command.effort.any() and not command.velocity.any()
        np.testing.assert_array_equal(command.damping, DESCRIPTION.passive_damping)


@pytest.mark.parametrize("truth", [Go2Truth.nominal(), B2Truth.nominal()], ids=["go2", "b2"])
def test_a_go2_or_b2_is_no_h1(truth: QuadrupedTruth) -> None:
    """The same messages, nothing in the arms' slots: nothing is sent, and the right robots are named."""
    clock = VirtualClock(10**9)
    device = Go2Device(truth)
    robot = H1Robot(VirtualTopics(device, clock), clock, hung_on_crane=True)
    with pytest.raises(WrongDeviceError, match=r"h1: .*16 to 19.*`go2` or `b2`.*Nothing was sent"):
        robot.connect()
    assert device.report()["commands"]["accepted"] == 0 and device.sport_name != ""
    found = list(H1Doctor(VirtualTopics(device, clock), clock, 1.0).run())
    assert any(f.severity is Severity.FAIL and "`go2`" in f.seen for f in found)


@pytest.mark.parametrize("kind", [Go2Robot, B2Robot])
def test_an_h1_is_no_go2_or_b2(kind: type[Go2Robot]) -> None:
    """Whatever its battery has, it is known by its arms: nothing is sent, and the right robot is named."""
    wire = H1Bench()
    robot = kind(wire.topics, wire.clock)
    with pytest.raises(WrongDeviceError, match=r"motors 16 to 19.*an H1.*robot `h1`.*Nothing was sent"):
        robot.connect()
    assert wire.received == [] and wire.device.controller_name == "ai"


@pytest.mark.parametrize("kind", [Go2Doctor, B2Doctor])
def test_the_doctors_of_other_robots_know_an_h1(kind: type[Go2Doctor]) -> None:
    """A failed check names it."""
    wire = H1Bench()
    found = list(kind(wire.topics, wire.clock, 1.0).run())
    assert any(f.severity is Severity.FAIL and "robot `h1`" in f.seen for f in found)


def test_an_unknown_check_is_refused() -> None:
    """Of the states."""
    with pytest.raises(UnknownNameError, match="loose"):
        H1Robot(H1Bench().topics, VirtualClock(), state_check="loose")  # type: ignore[arg-type]


def test_the_doctor_knows_a_sound_h1_on_its_crane() -> None:
    """Rate, temperature, level; its own controller is active, and the crane comes first."""
    wire = H1Bench()
    found = list(H1Doctor(wire.topics, wire.clock, 1.0).run())
    seen = {finding.seen: finding for finding in found}
    assert any("500 states a second" in text for text in seen)
    assert any("hottest motor" in text for text in seen)
    assert "crane first" in seen["own controller 'ai' is active"].do
    assert all(finding.severity is not Severity.FAIL for finding in found) and wire.received == []


# The inertial sensor in the torso.


@given(st.floats(-2.3, 2.3), st.floats(-3.0, 3.0), st.integers(0, 2**32))
def test_the_pelvis_follows_from_the_torso(angle: float, speed: float, seed: int) -> None:
    """Of any pelvis: turned with the torso's joint and back, orientation, turning and force are as before."""
    rng = np.random.default_rng(seed)
    pelvis = rng.standard_normal(4)
    pelvis /= np.linalg.norm(pelvis)
    turning, force = rng.standard_normal((2, 3))
    yaw, torso = np.array((np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))), np.empty(4)
    mujoco.mju_mulQuat(torso, pelvis, yaw)
    back = yaw * (1, -1, -1, -1)
    seen, felt = np.empty(3), np.empty(3)
    mujoco.mju_rotVecQuat(seen, turning, back)
    mujoco.mju_rotVecQuat(felt, force, back)
    seen[2] += speed
    found = pelvis_motion(torso, seen, felt, angle, speed)
    for part, expected in zip(found, (pelvis, turning, force), strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-12)


def test_a_turned_torso_does_not_turn_the_pelvis() -> None:
    """The states' orientation turns with the torso, the body state's stays; nothing trips."""
    wire = H1Bench()
    robot = wire.armed()
    command = default_command(robot)
    command.position_target[TORSO] = 0.4
    payloads: list[bytes] = []

    def seen(topic: str, payload: bytes) -> Iterable[bytes]:
        if topic == topics.LOW_STATE:
            payloads.append(payload)
        return (payload,)

    wire.topics.tamper = seen
    state = run_cycles(robot, wire.clock, 100, command)[-1]
    frame = H1StateDecoder().decode(payloads[-1])
    assert state.body is not None
    assert 2 * np.arctan2(frame.orientation[3], frame.orientation[0]) == pytest.approx(0.4, abs=0.05)
    np.testing.assert_allclose(state.body.orientation, (1.0, 0.0, 0.0, 0.0), atol=1e-5)
    np.testing.assert_allclose(state.body.angular_velocity, 0.0, atol=1e-5)
    np.testing.assert_allclose(state.body.acceleration, (0.0, 0.0, 9.81), atol=1e-5)
    assert state.body.foot_force.size == 0 and state.body.battery == pytest.approx(0.8)


# The emulator.


def test_a_motor_in_the_other_mode_is_off() -> None:
    """0x01 at a knee and 0x0A at an elbow: both are limp, the others follow."""
    target = np.array(DESCRIPTION.default_position)
    target[[KNEE, JOINTS.index("left_elbow_joint"), TORSO]] += 0.3
    zero = np.zeros(COUNT)

    def reached(modes: IntArray) -> FloatArray:
        device = H1Device(H1Truth.nominal(), controller="")
        command = GoCommand(
            target, zero, np.array(DESCRIPTION.stiffness), np.array(DESCRIPTION.damping), zero, modes
        )
        payload = GoCommandEncoder(ORDER.motors, np.zeros(layout.SLOTS, np.int64)).encode(command)
        for _ in range(1500):
            device.receive(topics.LOW_COMMAND, payload)
            device.tick()
        return np.asarray(np.abs(device.true_position - target))

    assert reached(SERVO_MODE).max() < 0.06
    other = SERVO_MODE.copy()
    other[KNEE], other[JOINTS.index("left_elbow_joint")] = 0x01, 0x0A
    error = reached(other)
    assert error[KNEE] > 0.2 and error[JOINTS.index("left_elbow_joint")] > 0.2 and error[TORSO] < 0.06


def test_the_vendors_example_moves_it_to_zero() -> None:
    """Targets and gains of h1_low_level_example.py of unitree_sdk2_python @ 37116c5: 10 s to zero."""
    device = H1Device(H1Truth.nominal(), controller="")
    start = device.true_position.copy()
    weak = SERVO_MODE == 0x01
    zero = np.zeros(COUNT)
    encoder = GoCommandEncoder(ORDER.motors, np.zeros(layout.SLOTS, np.int64))
    for step in range(1, 1201):
        share = min(1.0, step / 1000)
        command = GoCommand(
            (1.0 - share) * start,
            zero,
            np.where(weak, 60.0, 200.0),
            np.where(weak, 1.5, 5.0),
            zero,
            SERVO_MODE,
        )
        device.receive(topics.LOW_COMMAND, encoder.encode(command))
        for _ in range(10):
            device.tick()
    assert np.abs(device.true_position).max() < 0.05 and device.log.refused == 0


def test_the_truth_has_the_names_of_the_parameter_sets() -> None:
    """With and without bias; the nominal one is the nominal of the sets; a file comes back."""
    values = H1Truth.nominal().parameters()
    assert set(SPACES["biased"]().names) == set(values)
    space = SPACES["default"]()
    np.testing.assert_allclose([values[name] for name in space.names], space.nominal)
    drawn = H1Truth.draw("realistic", 5)
    assert H1Truth.from_json(drawn.to_json()) == drawn
    with pytest.raises(UnknownNameError, match="h2"):
        H1Truth.from_json({**drawn.to_json(), "robot": "h2"})
    with pytest.raises(ConfigurationError, match="19"):
        H1Truth.nominal(stiffness=(1.0,))
    with pytest.raises(UnknownNameError, match="H1 joint"):
        H1FaultPlan(fault_joint="left_wrist_yaw_joint")


# Whole runs.


def play(
    seconds: float,
    motion: str = "hold",
    truth: H1Truth | None = None,
    faults: Mapping[str, Any] | None = None,
) -> tuple[LoopReport, H1Device]:
    """Run a motion with the driver on an emulated robot in virtual time."""
    clock = VirtualClock(10**9)
    device = H1Device(truth or H1Truth.nominal(), plan=H1FaultPlan(**(faults or {})))
    robot = H1Robot(VirtualTopics(device, clock), clock, hung_on_crane=True)
    own: dict[str, Any] = {"motion": "excite", "excite": motion} if motion != "hold" else {"motion": motion}
    behaviour = make_behaviour(RunPlan(robot="h1", seconds=seconds, **own), DESCRIPTION)
    config = LoopConfig(duration_s=seconds, passive=PassiveConfig(timeout_s=1.0))
    loop = ControlLoop(robot, behaviour, Safety(DESCRIPTION), clock, lambda _: True, config)
    return loop.run(), device


@pytest.mark.parametrize("motion", ["multisine", pytest.param("chirp", marks=pytest.mark.slow)])
def test_a_collected_run_finishes_and_ends_damped(motion: str) -> None:
    """Every joint with hidden parameters; not one command is refused."""
    report, device = play(7.0, motion, H1Truth.draw("sensor", 3))
    assert (report.outcome, report.passive_confirmed) == (Outcome.FINISHED, True), report.reason
    assert device.controller_name == "" and device.log.refused == 0
    assert [kind for _, _, kind in device.log.changes] == ["damping", "stiff", "damping"]
    assert report.clipped.get("predicted_effort", 0) < 0.25 * report.cycles_sent


@pytest.mark.parametrize(
    ("fault", "outcome", "words"),
    [
        ("hot", Outcome.TRIPPED, "is at 130 °C, at most 85 °C"),
        ("nan", Outcome.TRIPPED, "not finite"),
        ("lost", Outcome.TRIPPED, "missed"),
        ("sport", Outcome.TRIPPED, "another program commands"),
        ("stop", Outcome.STOPPED, "L2+B"),
    ],
)
def test_each_fault_ends_in_damping(fault: str, outcome: Outcome, words: str) -> None:
    """The reason is named; the last command is damping."""
    report, device = play(2.0, faults={f"{fault}_after_s": 0.3})
    assert report.outcome is outcome and words in report.reason
    assert device.log.to_json()["last_kind"] == "damping"


def test_the_safety_filter_knows_its_limits() -> None:
    """A sound state arms; a tilted one does not."""
    wire = H1Bench()
    wire.robot.connect()
    state = wire.robot.read_state(1.0)
    safety = Safety(DESCRIPTION)
    cycle = CycleInput(now_ns=wire.clock.now_ns(), state=state)
    safety.arm(cycle)
    assert safety.step(cycle, None).flags == ()
