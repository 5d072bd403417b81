"""What carries a Go2, floor or stand: the judgement on states, and the driver's refusal."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.go2 import RESTING, STANDING, FakeBench, FakeGo2, efforts_under
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.control.safety.passive import make_passive
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION, JOINTS, LEGS, joint_ranges
from deal_hw.drivers.go2.descriptions.leg_geometry import GEOMETRY, SUPPORT
from deal_hw.drivers.go2.emulator.device import Go2Device
from deal_hw.drivers.go2.emulator.truth import HANGING, draw_truth, nominal_truth
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.go2.robot import Go2OnStandRobot, Go2Robot
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.virtual_topics import VirtualTopics
from deal_hw.drivers.unitree.go_messages.low_state import LowState
from deal_hw.drivers.unitree.support import Support, read_support
from deal_hw.errors import ConfigurationError, SafetyError
from deal_hw.types import FloatArray

STARTS = pytest.mark.parametrize(
    ("start", "sport"), [("lying", "normal"), ("lying", ""), ("standing", "normal")]
)
LOW, HIGH = np.array(joint_ranges()).T
POSES = st.tuples(*map(st.floats, LOW.tolist(), HIGH.tolist())).map(np.array)


# Geometry.


def test_feet_are_where_the_model_has_them() -> None:
    """In any pose, by the simulator; the model's feet are 2 mm behind the calf's line."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    data = mujoco.MjData(model)
    joints = [model.joint(name).qposadr[0] for name in JOINTS]
    data.qpos[:7] = (0, 0, 1, 1, 0, 0, 0)
    for pose in np.random.default_rng(0).uniform(LOW, HIGH, (100, 12)):
        data.qpos[joints] = pose
        mujoco.mj_kinematics(model, data)
        feet = np.array([data.geom(f"{leg}_foot").xpos for leg in LEGS]) - (0, 0, 1)
        np.testing.assert_allclose(GEOMETRY.foot_positions(pose), feet, atol=2.1e-3)


def test_jacobians_are_the_derivatives() -> None:
    """By central differences, of all feet by all joints."""
    steps = 1e-6 * np.eye(12)
    for pose in np.random.default_rng(1).uniform(LOW, HIGH, (20, 12)):
        moved = [
            (GEOMETRY.foot_positions(pose + s) - GEOMETRY.foot_positions(pose - s)) / 2e-6 for s in steps
        ]
        expected = np.zeros((12, 4, 3))
        for leg, jacobian in enumerate(GEOMETRY.foot_jacobians(pose)):
            expected[3 * leg : 3 * leg + 3, leg] = jacobian.T
        np.testing.assert_allclose(moved, expected, atol=1e-8)


@settings(max_examples=50, deadline=None)
@given(POSES, st.lists(st.floats(-100, 100), min_size=12, max_size=12))
def test_loads_and_efforts_are_each_others_inverse(pose: FloatArray, forces: list[float]) -> None:
    """Wherever the leg is not stretched along the line from hip to foot."""
    loads = np.array(forces).reshape(4, 3)
    if np.abs(np.linalg.det(GEOMETRY.foot_jacobians(pose))).min() > 1e-3:
        np.testing.assert_allclose(GEOMETRY.foot_loads(pose, efforts_under(pose, loads)), loads, atol=1e-8)


def test_the_weight_is_the_models() -> None:
    """15.2 kg."""
    model = mujoco.MjModel.from_xml_path(str(DESCRIPTION.mjcf))
    assert float(model.body_mass.sum()) * 9.81 == pytest.approx(GEOMETRY.weight_n, rel=0.005)


# The judgement.


def states(pose: FloatArray, *, load: float = 0.0, count: int = 150, **changes: Any) -> list[LowState]:
    """Return states of a level robot at rest whose feet carry a load together [N]."""
    effort = efforts_under(pose, np.array([[0.0, 0.0, load / 4]] * 4))
    return [dataclasses.replace(FakeGo2(pose=pose).state(), effort=effort, **changes)] * count


def leaning(angle: float, axis: int = 0) -> dict[str, Any]:
    """Return orientation and specific force of a body that leans [rad]: 0 to its side, 1 forwards."""
    orientation = np.zeros(4)
    orientation[0], orientation[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    sideways = np.array((0.0, 1.0, 0.0) if axis == 0 else (-1.0, 0.0, 0.0))
    force = 9.81 * (math.cos(angle) * np.array((0.0, 0.0, 1.0)) + math.sin(angle) * sideways)
    return {"orientation": orientation, "specific_force": force}


LEGS_DOWN = np.array(HANGING)
ONE_FOLDED = np.concatenate((LEGS_DOWN[:9], RESTING[9:]))
HALF_FOLDED = np.tile((-0.82, 0.83, -2.59, 0.82, 0.83, -2.59), 2)
"""Where friction leaves the legs of an emulated robot that is lifted while it lies."""
CASES: dict[str, tuple[Support, list[LowState]]] = {
    "lying": (Support.FLOOR, states(RESTING)),
    "lying, sport mode still stiff": (Support.FLOOR, states(RESTING, load=50.0)),
    "lying as seen on a robot": (Support.FLOOR, states(np.tile((0.0, 1.25, -2.81), 4))),
    "lying, leaning a little": (Support.FLOOR, states(RESTING, **leaning(0.3))),
    "standing": (Support.FLOOR, states(STANDING, load=GEOMETRY.weight_n)),
    "standing, dead foot sensors": (
        Support.FLOOR,
        states(STANDING, load=GEOMETRY.weight_n, foot_force=np.zeros(4, np.int64)),
    ),
    "standing, efforts read a third low": (Support.FLOOR, states(STANDING, load=0.67 * GEOMETRY.weight_n)),
    "hanging": (Support.HELD, states(LEGS_DOWN)),
    "hanging, held in the standing pose": (Support.HELD, states(STANDING, load=-12.0)),
    "hanging, feet sensors with offsets": (
        Support.HELD,
        states(LEGS_DOWN, foot_force=np.array((30, 17, 22, 0))),
    ),
    "hanging, one sensor stuck": (Support.HELD, states(LEGS_DOWN, foot_force=np.array((400, 0, 0, 0)))),
    "hanging, one leg left folded": (Support.HELD, states(ONE_FOLDED)),
    "hanging, leaning a little": (Support.HELD, states(LEGS_DOWN, **leaning(0.3, axis=1))),
    "hanging, legs left half folded": (Support.UNDECIDED, states(HALF_FOLDED)),
    "feet on the floor, half in a sling": (Support.UNDECIDED, states(STANDING, load=0.4 * GEOMETRY.weight_n)),
    "legs pulled down": (Support.UNDECIDED, states(STANDING, load=-0.4 * GEOMETRY.weight_n)),
    "limp legs on the floor": (Support.UNDECIDED, states(STANDING, foot_force=np.array((90, 80, 20, 20)))),
    "on its side": (Support.UNDECIDED, states(STANDING, **leaning(1.5))),
    "the reported case": (Support.UNDECIDED, states(RESTING, **leaning(0.85))),
    "on its back": (Support.UNDECIDED, states(STANDING, **leaning(3.1))),
    "swinging": (Support.UNDECIDED, states(LEGS_DOWN, angular_velocity=np.array((0.0, 0.6, 0.0)))),
    "walking": (Support.UNDECIDED, states(STANDING, load=GEOMETRY.weight_n, velocity=np.full(12, 2.0))),
    "falling": (Support.UNDECIDED, states(STANDING, specific_force=np.array((0.0, 0.0, 1.0)))),
    "orientation upside down": (
        Support.UNDECIDED,
        states(LEGS_DOWN, specific_force=np.array((0.0, 0.0, -9.81))),
    ),
    "orientation frozen": (
        Support.UNDECIDED,
        states(LEGS_DOWN, specific_force=leaning(0.3)["specific_force"]),
    ),
    "no orientation": (Support.UNDECIDED, states(LEGS_DOWN, orientation=np.zeros(4))),
    "a broken encoder": (Support.UNDECIDED, states(np.where(np.arange(12) == 4, np.nan, LEGS_DOWN))),
    "few states": (Support.UNDECIDED, states(LEGS_DOWN, count=49)),
    "no states": (Support.UNDECIDED, []),
}


@pytest.mark.parametrize("name", CASES)
def test_truth_table(name: str) -> None:
    """Each situation has its answer, and what does not tell comes with what to do."""
    expected, given_states = CASES[name]
    found = read_support(given_states, SUPPORT)
    assert found.support is expected, found
    assert bool(found.remedy) == (expected is Support.UNDECIDED)


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.5, 1.5), st.sampled_from((LEGS_DOWN, STANDING)))
def test_the_load_decides_where_the_legs_are_down(share: float, pose: FloatArray) -> None:
    """Below a quarter of the weight nothing is carried, above half it stands, between nobody knows."""
    found = read_support(states(pose, load=share * GEOMETRY.weight_n), SUPPORT).support
    if min(abs(abs(share) - 0.25), abs(share - 0.5)) < 1e-6:
        return
    expected = Support.FLOOR if share > 0.5 else Support.HELD if abs(share) < 0.25 else Support.UNDECIDED
    assert found is expected


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("angle", "support"), [(0.34, Support.HELD), (0.36, Support.UNDECIDED)])
def test_a_stand_is_level(axis: int, angle: float, support: Support) -> None:
    """To 0.35 rad, in any direction, as in the run that follows."""
    assert read_support(states(LEGS_DOWN, **leaning(angle, axis)), SUPPORT).support is support


@pytest.mark.parametrize(
    "changes", [{"force_m_s2": 0.0}, {"loaded": 0.2}, {"held_reach_m": 0.1}, {"level_rad": math.nan}]
)
def test_settings_that_mean_nothing_are_refused(changes: dict[str, Any]) -> None:
    """Neither negative, nor in the wrong order."""
    with pytest.raises(ConfigurationError):
        dataclasses.replace(SUPPORT, **changes)


@pytest.mark.parametrize("profile", ["sensor", "realistic"])
@pytest.mark.parametrize("on_stand", [False, True])
@STARTS
def test_an_emulated_robot_is_told_with_a_margin(
    profile: str, on_stand: bool, start: Any, sport: str
) -> None:
    """Noise, encoder bias and friction move nothing near a line: half the distance to each is left."""
    device = Go2Device(draw_truth(profile, 3), on_stand=on_stand, start=start, sport=sport)
    sent = device.advance_to(800_000_000)
    frames = [decode_low_state(payload) for topic, payload in sent if topic == topics.LOW_STATE][-150:]
    tight = dataclasses.replace(
        SUPPORT,
        held_reach_m=0.25,
        lying_reach_m=0.08,
        unloaded=0.12,
        loaded=0.75,
        foot_pressed=30.0,
        level_rad=0.1,
        joint_rad_s=0.4,
        body_rad_s=0.2,
        force_m_s2=0.3,
        sensors_rad=0.1,
    )
    assert read_support(frames, tight).support is (Support.HELD if on_stand else Support.FLOOR)


# The driver.


def rig(kind: type[Go2Robot], device: Go2Device, **settings: Any) -> tuple[Go2Robot, VirtualClock]:
    """Return a driver in front of an emulated robot, connected."""
    clock = VirtualClock(10**9)
    robot = kind(VirtualTopics(device, clock), clock, **settings)
    robot.connect()
    return robot, clock


@STARTS
def test_a_stand_is_refused_by_the_floors_robot(start: Any, sport: str) -> None:
    """Nothing is commanded, sport mode keeps the robot, and being made passive sends nothing either."""
    device = Go2Device(draw_truth("realistic", 1), on_stand=True, start=start, sport=sport)
    robot, clock = rig(Go2Robot, device)
    with pytest.raises(SafetyError, match=r"holds the robot in the air.*go2_on_stand.*--no-support-check"):
        robot.home(20.0)
    make_passive(robot, clock)
    assert (device.log.accepted, device.sport_name) == (0, sport)
    with pytest.raises(SafetyError, match="home"):
        robot.arm(1.0)


@STARTS
def test_the_floor_is_refused_by_the_stands_robot(start: Any, sport: str) -> None:
    """Before its controller lets go: a robot that is released while it stands falls."""
    device = Go2Device(draw_truth("realistic", 1), start=start, sport=sport)
    height = device.base_height
    robot, _ = rig(Go2OnStandRobot, device)
    with pytest.raises(SafetyError, match=r"on the floor.*take the robot `go2`"):
        robot.home(20.0)
    assert (device.log.accepted, device.sport_name) == (0, sport)
    assert device.base_height == pytest.approx(height, abs=0.01)


@pytest.mark.parametrize(("kind", "on_stand"), [(Go2Robot, False), (Go2OnStandRobot, True)])
@pytest.mark.parametrize("start", ["lying", "standing"])
def test_where_robot_and_model_agree_it_is_armed(kind: type[Go2Robot], on_stand: bool, start: Any) -> None:
    """Released from sport mode, lying or hanging."""
    device = Go2Device(draw_truth("realistic", 2), on_stand=on_stand, start=start)
    robot, _ = rig(kind, device)
    robot.home(20.0)
    robot.arm(1.0)
    assert device.sport_name == ""


def test_the_check_can_be_left_out() -> None:
    """For whoever tries a policy in the air, and knows it."""
    robot, _ = rig(Go2Robot, Go2Device(nominal_truth(), on_stand=True, sport=""), support_check=False)
    robot.home(20.0)
    robot.arm(1.0)


def test_a_robot_that_swings_is_waited_for() -> None:
    """Until it is still, but not for ever; then the message says what to do."""
    wire = FakeBench(Go2OnStandRobot, mode="")
    wire.robot.connect()
    wire.device.changes = {"angular_velocity": np.array((0.0, 0.7, 0.0))}
    with pytest.raises(SafetyError, match=r"uncertain.*is held in the air: it moves.*wait until it is still"):
        wire.robot.home(10.0)
    left, state = iter(range(300)), wire.device.state

    def calming() -> LowState:
        if next(left, None) is None:
            wire.device.changes = {}
        return state()

    wire.device.state = calming  # type: ignore[method-assign]
    wire.robot.home(10.0)
    wire.robot.arm(1.0)


def test_a_robot_that_is_lifted_while_sport_mode_lets_go_is_refused() -> None:
    """What is judged before the release is judged again after it."""
    wire = FakeBench()
    wire.robot.connect()
    serve = wire.device.serve

    def lift(service: str, request: Any) -> tuple[int, str]:
        if (service, request.api) == ("motion_switcher", 1003):
            wire.device.pose = LEGS_DOWN.copy()
        return serve(service, request)

    wire.device.serve = lift  # type: ignore[method-assign]
    with pytest.raises(SafetyError, match="holds the robot in the air"):
        wire.robot.home(10.0)
    assert wire.device.mode == "" and wire.device.received == []
