"""The B2: the Go2's driver and emulator with a B2's numbers; frames as those of the vendor's example."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.go2 import FakeBench

from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig
from deal_hw.control.process.channel import Outcome
from deal_hw.control.safety.passive import make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.data.recording.record import CycleRecord
from deal_hw.description import LegLimits, RobotDescription
from deal_hw.drivers.b2.description import (
    DESCRIPTION,
    GEOMETRY,
    ON_STAND,
    SUPPORT,
    joint_ranges,
    parameter_space,
    stand_space,
)
from deal_hw.drivers.b2.doctor import B2Doctor
from deal_hw.drivers.b2.emulator import B2, B2Truth
from deal_hw.drivers.b2.robot import B2Claim, B2OnStandRobot, B2Robot
from deal_hw.drivers.go2.descriptions.floor import JOINTS, LEGS
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.messages.low_command import LowCommand, LowCommandEncoder, decode_low_command
from deal_hw.drivers.go2.messages.wire import SLOT, WIRE_JOINTS
from deal_hw.drivers.go2.motions import sway_plan
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.support import Support, read_support
from deal_hw.errors import ConfigurationError, SafetyError, WrongDeviceError
from deal_hw.findings import Severity
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.motions.excitation.waveforms import Steps
from deal_hw.motions.posture import PostureBehaviour, PostureConfig
from deal_hw.robots import robot_entry
from deal_hw.sim.engine.model import load_model, model_with
from deal_hw.testing.robot_suite import RobotBench, RobotSuite, default_command
from deal_hw.types import FloatArray

BOTH = pytest.mark.parametrize("description", [DESCRIPTION, ON_STAND], ids=lambda d: d.name)
KINDS = pytest.mark.parametrize("kind", [B2Robot, B2OnStandRobot])
SUPPLY_V = 54.0
WEIGHT_N = 74.58 * 9.81


def faked(kind: type[B2Robot] = B2Robot, **settings: Any) -> FakeBench:
    """Return a fake with a B2's supply in front of its driver."""
    wire = FakeBench(kind, **settings)
    wire.device.changes = {"voltage": SUPPLY_V}
    return wire


def flip(payload: bytes) -> list[bytes]:
    """Change a byte of a joint's position."""
    return [payload[:90] + bytes([payload[90] ^ 0x55]) + payload[91:]]


def changed(kind: type[B2Robot], change: Callable[[bytes], Iterable[bytes]]) -> B2Robot:
    """Return a driver in front of a robot all of whose states are changed."""
    wire = faked(kind)
    wire.topics.tamper = lambda topic, payload: change(payload) if topic == topics.LOW_STATE else (payload,)
    assert isinstance(wire.robot, B2Robot)
    return wire.robot


class TestB2Robot(RobotSuite):
    kind: type[B2Robot] = B2Robot

    @pytest.fixture
    def bench(self) -> RobotBench:
        wire, silent = faked(self.kind), faked(self.kind)
        silent.device.talks = False
        return RobotBench(
            robot=wire.robot,
            foreign=changed(self.kind, lambda payload: [payload + bytes(100)]),
            newer=changed(self.kind, flip),
            silent=silent.robot,
            unplug=wire.topics.unplug,
            corrupt=lambda: wire.spoil_once(flip),
            greets=False,
        )


class TestB2OnStandRobot(TestB2Robot):
    kind: type[B2Robot] = B2OnStandRobot


# The driver.


def test_a_go2_is_known_by_its_supply() -> None:
    """Same messages, 8 cells in place of 14: nothing is sent to it, and the right robot is named."""
    wire = FakeBench(B2Robot)
    with pytest.raises(WrongDeviceError, match=r"b2: .*30\.5 V.*a B2 at least 40 V.*take robot `go2`"):
        wire.robot.connect()
    assert wire.device.received == [] and wire.device.requests == []


@KINDS
def test_every_command_has_the_b2s_motor_mode(kind: type[B2Robot]) -> None:
    """Targets, repeats and damping: 0x0A at every motor."""
    wire = faked(kind)
    robot = wire.armed()
    robot.send_command(default_command(robot))
    robot.repeat()
    robot.passive()
    wire.topics.receive(0.01)
    modes = {int(mode) for _, command in wire.device.received for mode in command.mode}
    assert modes == {0x0A} and len(wire.device.received) > 3


def test_passive_is_damping_as_described() -> None:
    """Kd 10 at every joint, nothing else, until the motors' efforts show it."""
    wire = faked()
    robot = wire.armed()
    robot.send_command(default_command(robot))
    assert make_passive(robot, wire.clock)
    command = wire.device.command
    assert command is not None and not command.stiffness.any() and not command.effort.any()
    np.testing.assert_allclose(command.damping, DESCRIPTION.passive_damping)


def test_standing_is_laid_down_before_the_release() -> None:
    """By the sport service's StandDown, which a B2 has under the Go2's number."""
    pose = np.array(DESCRIPTION.default_position)
    wire = faked(mode="ai", pose=pose)
    loads = np.array([[0.0, 0.0, WEIGHT_N / 4]] * 4)
    wire.device.changes["effort"] = -np.einsum("lij,li->lj", GEOMETRY.foot_jacobians(pose), loads).reshape(12)
    wire.robot.connect()
    wire.robot.home(10.0)
    calls = [(service, request.api) for service, request in wire.device.requests]
    assert calls.index(("sport", 1005)) < calls.index(("motion_switcher", 1003))
    assert wire.device.mode == ""


@pytest.mark.parametrize(
    ("kind", "on_stand", "words"),
    [(B2Robot, True, "take the robot `b2_on_stand`"), (B2OnStandRobot, False, "take the robot `b2`")],
)
def test_the_other_support_is_refused_with_the_right_robot(
    kind: type[B2Robot], on_stand: bool, words: str
) -> None:
    """A hanging b2 and a lying b2_on_stand: no command is sent."""
    wire = faked(kind, on_stand=on_stand)
    wire.robot.connect()
    with pytest.raises(SafetyError, match=words):
        wire.robot.home(10.0)
    assert wire.device.received == []


def test_the_claim_names_the_robot() -> None:
    """Messages about a second program begin with it."""
    assert B2Claim.robot == B2Robot.wording.name == "b2"


# The description.


@BOTH
def test_every_limit_for_legs_has_a_source(description: RobotDescription) -> None:
    """Assumptions are called assumptions."""
    for field in dataclasses.fields(LegLimits):
        assert description.sources[f"legs.{field.name}"]
    for name in ("stiffness", "damping", "passive_damping", "rest_position", "limits", "mjcf", "sensor"):
        assert description.sources[name]


@BOTH
def test_description_and_model_agree(description: RobotDescription) -> None:
    """Joints in order, ranges, efforts, gains, and the motors' period."""
    robot = load_model(description)
    model = robot.model
    assert [model.joint(name).range.tolist() for name in JOINTS] == [list(pair) for pair in joint_ranges()]
    low, high = model.actuator_forcerange[list(robot.actuator)].T
    np.testing.assert_array_equal(high, description.effort_limit)
    np.testing.assert_array_equal(low, -high)
    gains = model.actuator_gainprm[list(robot.actuator), 0]
    np.testing.assert_array_equal(gains, description.stiffness)
    assert math.isclose(robot.step_s * description.device_rate_hz, 1.0)


@BOTH
def test_rest_and_default_pose_can_be_commanded(description: RobotDescription) -> None:
    """Inside the limits of targets; limp calves on their stop do not trip."""
    low, high = np.array(description.limits.target).T
    for pose in (description.rest_position, description.default_position):
        assert ((low <= pose) & (pose <= high)).all()
    low, _ = np.array(description.limits.trip_position).T
    assert (low[2::3] < -2.83).all()


def test_legs_and_weight_are_the_models() -> None:
    """The closed form of the legs has the feet where MuJoCo has them, and 74.6 kg."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    assert float(model.body_mass.sum()) * 9.81 == pytest.approx(GEOMETRY.weight_n, rel=0.005)
    data = mujoco.MjData(model)
    joints = [int(model.joint(name).qposadr[0]) for name in JOINTS]
    low, high = np.array(joint_ranges()).T
    for pose in np.random.default_rng(0).uniform(low, high, (20, 12)):
        data.qpos[:7] = (0, 0, 1, 1, 0, 0, 0)
        data.qpos[joints] = pose
        mujoco.mj_kinematics(model, data)
        feet = np.array([data.geom(f"{leg}_foot").xpos for leg in LEGS]) - (0, 0, 1)
        np.testing.assert_allclose(GEOMETRY.foot_positions(pose), feet, atol=1e-6)


def test_left_and_right_legs_are_mirror_images() -> None:
    """Masses and inertias of each leg equal the front left one's, with y mirrored, and x of the hips."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    for leg in LEGS:
        side, end = (1.0 if leg[1] == "L" else -1.0), (1.0 if leg[0] == "F" else -1.0)
        for part in ("hip", "thigh", "calf"):
            ours, first = model.body(f"{leg}_{part}"), model.body(f"FL_{part}")
            assert ours.mass == first.mass
            np.testing.assert_allclose(ours.inertia, first.inertia, rtol=1e-6)
            mirrored = (end if part == "hip" else 1.0, side, 1.0)
            np.testing.assert_allclose(ours.ipos, first.ipos * mirrored, atol=1e-9)


def test_nominal_values_of_the_parameter_sets_are_the_models() -> None:
    """On the floor gains; on the stand damping holds the joint's friction, too."""
    for description, space in ((DESCRIPTION, parameter_space()), (ON_STAND, stand_space())):
        robot = load_model(description)
        again = model_with(robot, space, space.nominal)
        for name in ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_armature"):
            np.testing.assert_allclose(getattr(again, name), getattr(robot.model, name), rtol=1e-9)


# The frames of the vendor's example: unitree_sdk2 @ 21d0a3b, example/b2/b2_stand_example.cpp.

LYING, UP = (0.0, 1.36, -2.65) * 4, (0.0, 0.67, -1.3) * 4
SPREAD = (-0.5, 1.36, -2.65, 0.5, 1.36, -2.65) * 2
"""Its poses, in the order of the wire (legs FR, FL, RR, RL) [rad]."""


def frame(pose: FloatArray, mode: int = 0x0A) -> bytes:
    """Return the example's frame that holds a pose given in the order of the wire, (12,) [rad]."""
    zero = np.zeros(12)
    command = LowCommand(pose[SLOT], zero, np.full(12, 1000.0), np.full(12, 10.0), zero, np.full(12, mode))
    return LowCommandEncoder(mode).encode(command)


def stand_example(start: FloatArray, mode: int) -> Iterator[bytes]:
    """Yield the example's frames: to lying, up, hold, down, to lying with the legs spread."""
    lying, up, spread = np.array(LYING), np.array(UP), np.array(SPREAD)
    parts = ((start, lying, 500), (lying, up, 900), (up, up, 1000), (up, lying, 1100), (lying, spread, 500))
    for begin, end, count in parts:
        for share in np.arange(1, count + 1) / count:
            yield frame(np.asarray((1.0 - share) * begin + share * end), mode)


def test_a_frame_has_what_the_vendors_example_fills_in() -> None:
    """Twenty motors of mode 0x0A; q, dq, tau, kp, kd of motor 3, the hip of FL; stop values beyond 11."""
    payload = frame(np.array(SPREAD))
    assert payload[4:7] == b"\xfe\xef\xff"
    assert [payload[26], *(payload[60 + 36 * slot] for slot in range(19))] == [0x0A] * 20
    third = np.frombuffer(payload, "<f4", 5, 28 + 36 * 3)
    np.testing.assert_allclose(third, (0.5, 0.0, 0.0, 1000.0, 10.0))
    spare = np.frombuffer(payload, "<f4", 5, 28 + 36 * 12)
    np.testing.assert_allclose(spare, (2.146e9, 16000.0, 0.0, 0.0, 0.0))


def test_motors_have_the_vendors_order() -> None:
    """0 is the hip of the right front leg, 11 the calf of the left hind one; targets arrive at their own."""
    assert (WIRE_JOINTS[0], WIRE_JOINTS[5], WIRE_JOINTS[11]) == (
        "FR_hip_joint",
        "FL_calf_joint",
        "RL_calf_joint",
    )
    pose = np.linspace(0.0, 0.11, 12)
    decoded = decode_low_command(frame(pose)).position
    for joint, value in zip(WIRE_JOINTS, pose, strict=True):
        assert decoded[JOINTS.index(joint)] == pytest.approx(value, rel=1e-6)


# The emulator.


@pytest.fixture
def make_b2(make_go2: Any) -> Callable[..., Any]:
    """Return what makes an emulated B2 in virtual time with a client."""
    return lambda **options: make_go2(**{"truth": B2Truth.nominal(), **options})


@pytest.mark.parametrize("mode", [0x0A, pytest.param(0x01, marks=pytest.mark.slow)])
def test_the_vendors_stand_example(make_b2: Any, mode: int) -> None:
    """It releases sport mode as the example does, stands, and lies down; no command is refused."""
    bench = make_b2(sport="ai")
    while bench.mode():
        assert bench.call("motion_switcher", 1003).code == 0
        bench.run(1000)
    start = bench.run(2)[0].position
    heights, hottest = [], 0
    for payload in stand_example(start[np.argsort(SLOT)], mode):
        bench.device.receive(topics.LOW_COMMAND, payload)
        (state,) = bench.run(2)
        heights.append(bench.device.base_height)
        hottest = max(hottest, int(state.temperature.max()))
    commands = bench.device.report()["commands"]
    assert (commands["accepted"], commands["refused"]) == (4000, 0)
    # Links of 0.35 m at 0.67 and -0.63 rad, a foot of 0.032 m: 0.35 * (0.784 + 0.808) + 0.032 = 0.589 m,
    # less what the springs give under 183 N a foot.
    assert 0.56 < heights[2399] < 0.589
    assert heights[-1] < 0.25 and hottest < 60


def test_motors_ignore_other_modes(make_b2: Any) -> None:
    """Mode 0 is off, and so is a number that no example sends."""
    bench = make_b2(sport="", start="standing")
    for mode in (0x00, 0x02):
        zero = np.zeros(12)
        command = LowCommand(zero, zero, np.full(12, 500.0), zero, zero, np.full(12, mode))
        (state,) = bench.run(2, command)
        (state,) = bench.run(2)
        assert not state.effort.any()


@pytest.mark.parametrize("profile", ["sensor", "realistic"])
@pytest.mark.parametrize("on_stand", [False, True])
@pytest.mark.parametrize("start", ["lying", "standing"])
def test_floor_and_stand_are_told_apart(make_b2: Any, profile: str, on_stand: bool, start: str) -> None:
    """Whatever the noise, the payload and the posture of sport mode."""
    bench = make_b2(truth=B2Truth.draw(profile, 3), on_stand=on_stand, start=start, sport="normal")
    found = read_support(bench.run(800)[-150:], SUPPORT)
    assert found.support is (Support.HELD if on_stand else Support.FLOOR), found.seen


def test_a_standing_robot_carries_its_weight(make_b2: Any) -> None:
    """By the closed form of the legs and the estimated efforts; the battery gives the current for it."""
    state = make_b2(sport="normal", start="standing").run(2)[-1]
    loads = GEOMETRY.foot_loads(state.position, state.effort)[:, 2].sum()
    # The hips of a standing robot carry a part of the weight of their legs, which the closed form neglects.
    assert loads == pytest.approx(WEIGHT_N, rel=0.07)
    assert 50.0 < state.voltage < 58.8 and state.current > 2.0


def test_a_truth_is_read_back_and_not_by_a_go2() -> None:
    """The file says for which robot it is."""
    truth = B2Truth.draw("realistic", 7)
    assert B2Truth.from_json(truth.to_json()) == truth
    assert len(truth.walk_parameters()) == 29
    with pytest.raises(ConfigurationError, match=r"truth of a b2, not of a go2"):
        Go2Truth.from_json(truth.to_json())


def test_b2_and_go2_of_one_seed_differ() -> None:
    """Each robot draws from a stream of its own."""
    assert B2Truth.draw("ideal", 1).stiffness != Go2Truth.draw("ideal", 1).stiffness
    assert B2.servo_modes == (0x0A, 0x01)


# The doctor.


@pytest.mark.parametrize(("volts", "fails"), [(SUPPLY_V, False), (30.5, True)])
def test_doctor_listens_and_knows_the_supply(volts: float, fails: bool) -> None:
    """A B2 is sound, a Go2 in its place is named; no command is sent."""
    wire = faked()
    wire.device.changes = {"voltage": volts}
    found = list(B2Doctor(wire.topics, wire.clock, 1.0).run())
    assert wire.device.received == []
    assert any("500 states a second" in finding.seen for finding in found)
    failed = [finding.seen for finding in found if finding.severity is Severity.FAIL]
    assert bool(failed) == fails and all("take robot `go2`" in text for text in failed)


def test_doctor_names_another_robot_by_its_states() -> None:
    """A G1's states are longer."""
    wire = faked()
    wire.topics.tamper = lambda topic, payload: (
        [payload + bytes(912)] if topic == topics.LOW_STATE else [payload]
    )
    found = list(B2Doctor(wire.topics, wire.clock, 1.0).run())
    assert any("no B2 states" in finding.seen and "G1" in finding.do for finding in found)


# Motions.


def test_a_standing_b2_sways_over_its_feet() -> None:
    """Targets stay inside the limits, every joint moves, and no foot moves against another by 5 mm."""
    plan = sway_plan(load_model(DESCRIPTION), np.random.default_rng(1), 2.0)
    assert plan.robot == "b2" and isinstance(plan.wave, Steps)
    targets = np.array(DESCRIPTION.default_position) + np.array(plan.wave.value)
    low, high = np.array(DESCRIPTION.limits.target).T
    assert ((low <= targets) & (targets <= high)).all()
    assert np.ptp(targets, axis=0).min() > 0.02
    feet = GEOMETRY.foot_positions(targets)
    apart = np.linalg.norm(feet[:, :, None] - feet[:, None, :], axis=-1)
    assert np.ptp(apart, axis=0).max() < 0.005


def test_a_standing_robot_stays_where_it_is_by_its_own_sensors(make_b2: Any) -> None:
    """The path of a B2 that stands for a second: less than a centimetre, by the legs of a B2."""
    bench = make_b2(truth=B2Truth.nominal("sensor", 1), sport="normal", start="standing")
    frames = bench.run(1000)

    def stacked(*names: str) -> SimpleNamespace:
        return SimpleNamespace(**{name: np.stack([getattr(one, name) for one in frames]) for name in names})

    recording = stacked("position", "velocity", "effort", "orientation", "angular_velocity", "specific_force")
    recording.body = recording
    recording.acceleration = recording.specific_force
    recording.device_s = np.array([one.tick_ms for one in frames]) * 1e-3
    entry = robot_entry("b2")
    track = entry.load(entry.odometry)(recording)
    assert np.abs(track.place).max() < 0.01


# A run.


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_run_stands_up_holds_and_lies_down(seed: int) -> None:
    """Released from sport mode, behind the safety filter, with hidden payload and friction; then damped."""
    clock = VirtualClock(10**9)
    device = Go2Device(B2Truth.draw("realistic", seed), sport="ai", start="standing")
    robot = B2Robot(VirtualTopics(device, clock), clock)
    hold = PostureBehaviour(HoldBehaviour(DESCRIPTION), DESCRIPTION, 1.0, PostureConfig())
    heights: list[float] = []

    def note(record: CycleRecord) -> bool:
        heights.append(device.base_height)
        return True

    config = LoopConfig(duration_s=hold.longest_s)
    report = ControlLoop(robot, hold, Safety(DESCRIPTION), clock, note, config, end=hold.end).run()
    assert report.outcome is Outcome.FINISHED, report.reason
    # Links of 0.35 m at 0.8 and -0.7 rad, less what springs of 500 N·m/rad give under the weight.
    assert 0.45 < max(heights) < 0.35 * (math.cos(0.8) + math.cos(0.7)) + 0.032
    assert heights[-1] < 0.15 and device.log.to_json()["last_kind"] == "damping"
    assert device.sport_name == ""
