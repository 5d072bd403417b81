"""robot.yaml: written, read again, compared with its MJCF, kept in a dataset's folder."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deal_hw.clock import VirtualClock
from deal_hw.errors import ConfigurationError, DatasetError, TransportTimeoutError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.robots.dataset_robot import FOLDER, store_robot, stored_description
from deal_hw.sim.robots.holding import hold
from deal_hw.sim.robots.robot_file import (
    ActuatorEntry,
    JointEntry,
    RobotFile,
    read_robot_file,
    write_robot_file,
)
from deal_hw.sim.robots.simulated import SimulatedRobot, SimulatedTruth, draw_truth
from deal_hw.sim.robots.user_robot import derive_robot, read_robot
from deal_hw.types import JointCommand, Status
from deal_hw.workflows.robot import carries_robot, default_space

LINK = """
<body name="{name}">
  <joint name="{joint}" axis="0 1 0" range="-2 2" limited="true" damping="0.3" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>{inner}</body>
"""
ELBOW = LINK.format(name="lower", joint="elbow", inner="")
SERVO = '<position joint="{}" kp="12" kv="0.1" forcerange="-20 20" ctrlrange="-1.5 1.5" ctrllimited="true"/>'


def arm(bodies: str = "", actuators: str = "", option: str = 'timestep="0.002"', head: str = "") -> str:
    """Return the MJCF of an arm of two joints."""
    bodies = bodies or LINK.format(name="upper", joint="shoulder", inner=ELBOW)
    actuators = actuators or SERVO.format("shoulder") + SERVO.format("elbow")
    return (
        f'<mujoco model="arm"><compiler angle="radian"/><option integrator="implicitfast" {option}>'
        f'<flag contact="disable"/></option>{head}<worldbody>{bodies}</worldbody>'
        f"<actuator>{actuators}</actuator></mujoco>"
    )


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The arm's file."""
    path = tmp_path / "arm.xml"
    path.write_text(arm(), encoding="utf-8")
    return path


def written(model: Path) -> Path:
    """Return the robot.yaml that the model tells, beside it."""
    path = model.parent / "robot.yaml"
    path.write_text(write_robot_file(derive_robot(model, control_rate_hz=50.0).file), encoding="utf-8")
    return path


positive = st.floats(1e-9, 1e3)
unlimited = st.none() | positive
sensed = st.floats(0.0, 6.0)


@st.composite
def joints(draw: st.DrawFn) -> JointEntry:
    """Draw a joint."""
    low, span = draw(st.floats(-1e3, 1e3)), draw(st.floats(1e-3, 1e3))
    ranged = draw(st.booleans())
    actuator = ActuatorEntry(
        stiffness=draw(st.just(0.0) | positive),
        damping=draw(st.just(0.0) | positive),
        effort_limit=draw(unlimited),
    )
    return JointEntry(
        name=draw(st.text(min_size=1, max_size=20)),
        unit=draw(st.sampled_from(["rad", "m"])),
        default_position=low + 0.5 * span,
        position_range=(low, low + span) if ranged else None,
        velocity_limit=draw(unlimited),
        sensor_noise=draw(sensed),
        sensor_resolution=draw(sensed),
        actuator=draw(st.none() | st.just(actuator)),
    )


@st.composite
def robots(draw: st.DrawFn) -> RobotFile:
    """Draw a robot.yaml."""
    driven = dataclasses.replace(draw(joints()), actuator=ActuatorEntry(stiffness=draw(positive)))
    others = draw(st.lists(joints(), max_size=4, unique_by=lambda joint: joint.name))
    rate = draw(st.floats(0.01, 1e4))
    return RobotFile(
        version=1,
        name=draw(st.text(min_size=1, max_size=30).filter(lambda t: t.isprintable() and "/" not in t)),
        mjcf=draw(st.text(min_size=1, max_size=30)),
        actuation=draw(st.sampled_from(["position", "motor"])),
        control_rate_hz=rate,
        state_rate_hz=rate * draw(st.integers(1, 20)),
        joints=(driven, *(joint for joint in others if joint.name != driven.name)),
        floating_base=draw(st.none() | st.text(min_size=1, max_size=20)),
        feet=tuple(draw(st.lists(st.text(max_size=20), max_size=4))),
    )


def named_feet(*feet: str) -> RobotFile:
    """Return a robot whose feet have these names."""
    joint = JointEntry(name="a", unit="rad", default_position=0.0, actuator=ActuatorEntry(stiffness=1.0))
    return RobotFile(
        version=1,
        name="r",
        mjcf="r.xml",
        actuation="position",
        control_rate_hz=50.0,
        state_rate_hz=500.0,
        joints=(joint,),
        feet=feet,
    )


@settings(max_examples=60, deadline=None)
@given(robots())
@example(named_feet("\x85", "\u2028", "a\nb\nc", "ü"))
def test_what_is_written_is_read_again(robot: RobotFile) -> None:
    """Whatever a name looks like to YAML, and however small a number is."""
    import tempfile

    text = write_robot_file(robot)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.yaml"
        path.write_text(text, encoding="utf-8")
        assert read_robot_file(path) == robot
    fields = [line for line in text.splitlines() if re.match(r" *(- )?[a-z_]+: ", line)]
    assert all("  # " in line for line in fields)


def test_the_model_tells_what_it_knows(model: Path) -> None:
    """Names, units, gains, effort limits; targets stay in the narrower of joint range and ctrlrange."""
    file = derive_robot(model, control_rate_hz=50.0, state_rate_hz=200.0).file
    assert (file.name, file.mjcf, file.actuation, file.floating_base) == ("arm", "arm.xml", "position", None)
    assert [joint.name for joint in file.joints] == ["shoulder", "elbow"]
    assert file.joints[0] == JointEntry(
        name="shoulder",
        unit="rad",
        position_range=(-1.5, 1.5),
        actuator=ActuatorEntry(stiffness=12.0, damping=0.1, effort_limit=20.0),
    )


def test_a_description_has_what_both_say(model: Path) -> None:
    """Rates, limits and noise of robot.yaml, gains of the MJCF, the model's own step."""
    path = written(model)
    text = path.read_text(encoding="utf-8").replace("velocity_limit: null", "velocity_limit: 5.0")
    text = text.replace("sensor_noise: 0.0", "sensor_noise: 0.001").replace(
        "state_rate_hz: 50.0", "state_rate_hz: 100.0"
    )
    path.write_text(text, encoding="utf-8")
    found = read_robot(path).description()
    assert (found.control_rate_hz, found.state_rate_hz, found.device_rate_hz) == (50.0, 100.0, 500.0)
    assert found.stiffness == (12.0, 12.0) and found.sensor.noise == (0.001, 0.001)
    # 5 rad/s at 50 commands a second; 25 % of 3 rad beyond the range.
    assert found.limits.target_step == (0.1, 0.1) and found.limits.trip_velocity == (5.0, 5.0)
    assert found.limits.trip_position[0] == pytest.approx((-2.25, 2.25))


CHANGES: list[tuple[str, str, str]] = [
    (
        "stiffness: 12.0",
        "stiffness: 13.0",
        "stiffness of shoulder is 13, the MJCF's 12; write 12.0, or change",
    ),
    ("damping: 0.1", "damping: 0.2", "damping of shoulder is 0.2, the MJCF's 0.1; write 0.1"),
    ("effort_limit: 20.0", "effort_limit: 5.0", "effort_limit of shoulder is 5, the MJCF's 20; write 20.0"),
    ("unit: rad", "unit: m", "unit of shoulder is m; write rad"),
    (
        "[-1.5, 1.5]",
        "[-2.5, 1.5]",
        "position_range of shoulder is -2.5 to 1.5, the MJCF's range -2 to 2; stay",
    ),
    ("name: shoulder", "name: hip", "the MJCF has no joint hip; its joints are shoulder, elbow"),
    ("actuation: position", "actuation: motor", "actuation is 'motor'; write position, as the MJCF has it"),
    ("floating_base: null", "floating_base: root", "floating_base is 'root'; write null, as the MJCF has it"),
    ("feet: []", "feet: [toe]", "foot 'toe' is no sphere geom of the MJCF; its spheres: none has a name"),
    (
        "_rate_hz: 50.0",
        "_rate_hz: 2000.0",
        "is faster than the MJCF's timestep of 0.002 s; write at most 500",
    ),
    ("mjcf: arm.xml", "mjcf: leg.xml", "its model leg.xml does not exist"),
    ("stiffness: 12.0", "stifness: 12.0", "field joints[0].actuator.stifness is 12.0; Unexpected keyword"),
    ("name: arm ", "#", "field name is missing"),
    ("control_rate_hz: 50.0", "control_rate_hz: 30.0", "allowed: whole multiples of control_rate_hz 30"),
    ("position_range: [-1.5, 1.5]", "position_range: [1.5, -1.5]", "the lower one first, or null"),
    ("default_position: 0.0", "default_position: 1.6", "allowed: -1.5 to 1.5 (position_range)"),
    ("sensor_noise: 0.0", "sensor_noise: -0.1", "field sensor_noise is -0.1; allowed: 0 to 6.28319 rad"),
    ("velocity_limit: null", "velocity_limit: 0", "a number above 0, or null for no limit"),
    ("control_rate_hz: 50.0", "control_rate_hz: fast", "field control_rate_hz is 'fast'"),
]


@pytest.mark.parametrize(("old", "new", "words"), CHANGES, ids=[new for _, new, _ in CHANGES])
def test_a_contradiction_is_refused(model: Path, old: str, new: str, words: str) -> None:
    """The message says what to write instead."""
    path = written(model)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 2 if "rate" in old and "2000" in new else 1), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=re.escape(words)) as raised:
        read_robot(path)
    assert str(path) in str(raised.value)


NUMBERS = {
    "control_rate_hz: 50.0": "control_rate_hz: {}",
    "state_rate_hz: 50.0": "state_rate_hz: {}",
    "physics_step: 0.002": "physics_step: {}",
    "default_position: 0.0": "default_position: {}",
    "position_range: [-1.5, 1.5]": "position_range: [-1.5, {}]",
    "velocity_limit: null": "velocity_limit: {}",
    "sensor_noise: 0.0": "sensor_noise: {}",
    "sensor_resolution: 0.0": "sensor_resolution: {}",
    "stiffness: 12.0": "stiffness: {}",
    "damping: 0.1": "damping: {}",
    "effort_limit: 20.0": "effort_limit: {}",
}
"""Each number of a robot.yaml, and how another takes its place."""


@pytest.mark.parametrize(
    "value", ["1e308", "1.0e+308", "-1.0e+308", ".nan", ".inf", "-.inf", "1.0e+11", "text"]
)
@pytest.mark.parametrize("old", NUMBERS)
def test_a_number_that_no_robot_has_is_refused(model: Path, old: str, value: str) -> None:
    """A velocity limit of 1e308 would be none; each number is refused by its name."""
    path = written(model)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, NUMBERS[old].format(value), 1), encoding="utf-8")
    with pytest.raises(ConfigurationError) as raised:
        read_robot_file(path)
    words = str(raised.value)
    assert str(path) in words and old.partition(":")[0] in words and "\n" not in words
    assert any(said in words for said in ("allowed: ", "valid number", "finite number"))


def test_the_message_says_what_a_joint_can_do(model: Path) -> None:
    """Given, allowed, and why."""
    path = written(model)
    text = path.read_text(encoding="utf-8").replace("velocity_limit: null", "velocity_limit: 1.0e+308", 1)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(
        ConfigurationError,
        match=r"field velocity_limit is 1e\+308 rad/s; allowed: up to 10000 rad/s \(the fastest joints",
    ):
        read_robot_file(path)


def test_joints_and_actuators_that_are_left_out(model: Path) -> None:
    """Each is named, with what to do."""
    path = written(model)
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: text.index("  - name: elbow")], encoding="utf-8")
    with pytest.raises(ConfigurationError, match="the MJCF's joints elbow are not among `joints`; add them"):
        read_robot(path)
    cut = text[: text.rindex("    actuator:")] + "    actuator: null\n"
    path.write_text(cut, encoding="utf-8")
    with pytest.raises(
        ConfigurationError, match="an actuator of the MJCF drives elbow; write its `actuator`"
    ):
        read_robot(path)
    model.write_text(arm(actuators=SERVO.format("shoulder")), encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(
        ConfigurationError, match="no actuator of the MJCF drives elbow; write `actuator: null`"
    ):
        read_robot(path)


def test_a_model_with_two_robots(tmp_path: Path) -> None:
    """It is refused with both named; two arms of one robot are taken where an option allows it."""
    path = tmp_path / "two.xml"
    bodies = LINK.format(name="left", joint="left", inner="") + LINK.format(
        name="right", joint="right", inner=""
    )
    path.write_text(arm(bodies, SERVO.format("left") + SERVO.format("right")), encoding="utf-8")
    with pytest.raises(
        ConfigurationError, match=r"holds 2 robots: left \(left\); right \(right\).*--several-trees"
    ):
        derive_robot(path, control_rate_hz=50.0)
    assert len(derive_robot(path, control_rate_hz=50.0, several_trees=True).file.joints) == 2


@pytest.mark.parametrize(("kp", "diverges"), [("12", None), ("150", False), ("250", True)])
def test_holding(model: Path, kp: str, diverges: bool | None) -> None:
    """A sound arm holds; stiff servos at a long timestep shake more and more, or break the simulation."""
    servo = SERVO.replace('kp="12" kv="0.1" forcerange="-20 20"', f'kp="{kp}"')
    text = arm(actuators=servo.format("shoulder") + servo.format("elbow"), option='timestep="0.02"')
    model.write_text(text.replace("implicitfast", "Euler"), encoding="utf-8")
    found = hold(derive_robot(model, control_rate_hz=50.0))
    assert found.diverged == bool(diverges)
    assert found.unstable == (("shoulder", "elbow") if diverges is False else ())
    if diverges is None:
        # Two links hang from a servo of 12 N·m/rad: 0.5 kg at 0.1 and 0.3 m are some 0.9 N·m.
        assert np.all(np.abs(found.sag) < 0.2)


MESH = '<asset><mesh name="lump" file="lump.obj"/></asset><include file="more.xml"/>'


@pytest.fixture
def spread(tmp_path: Path) -> Path:
    """A robot.yaml whose MJCF has an include beside it and a mesh in another folder."""
    model = tmp_path / "source" / "mjcf" / "arm.xml"
    model.parent.mkdir(parents=True)
    text = arm(head=MESH).replace('angle="radian"', 'angle="radian" meshdir="../meshes"')
    model.write_text(
        text.replace('type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"', 'mesh="lump" type="mesh"', 1),
        encoding="utf-8",
    )
    (model.parent / "more.xml").write_text(
        "<mujocoinclude><size memory='1M'/></mujocoinclude>", encoding="utf-8"
    )
    (tmp_path / "source" / "meshes").mkdir()
    corners = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    (tmp_path / "source" / "meshes" / "lump.obj").write_text(corners, encoding="utf-8")
    (tmp_path / "source" / "meshes" / "unused.obj").write_text(corners, encoding="utf-8")
    return written(model)


def test_a_dataset_keeps_what_the_model_needs(spread: Path, tmp_path: Path) -> None:
    """MJCF, include and mesh lie as they did to each other; the description is found again, and no more."""
    robot = read_robot(spread)
    dataset = tmp_path / "dataset"
    dataset.mkdir()
    assert not carries_robot(dataset)
    store_robot(robot, dataset)
    store_robot(robot, dataset)
    assert carries_robot(dataset) and not [path for path in dataset.iterdir() if path.name != FOLDER]
    kept = sorted(str(p.relative_to(dataset / FOLDER)) for p in (dataset / FOLDER).rglob("*") if p.is_file())
    assert kept == ["files.json", "meshes/lump.obj", "mjcf/arm.xml", "mjcf/more.xml", "robot.yaml"]
    description = robot.description()
    values = json.loads(json.dumps(description.to_json()))
    digest = description.digest()
    (tmp_path / "source").rename(tmp_path / "moved")
    found = stored_description(dataset, values)
    assert found.digest() == digest and found.limits == description.limits
    assert load_model(found).model.nmesh == 1
    assert read_robot(dataset / FOLDER / "robot.yaml").description().digest() == digest


SPOILT: list[tuple[Callable[[Path], object], str]] = [
    (lambda folder: folder.rename(folder.parent / "away"), "there is no .*robot/files.json"),
    (lambda folder: (folder / "mjcf" / "arm.xml").unlink(), "mjcf/arm.xml is missing"),
    (lambda folder: (folder / "meshes" / "lump.obj").write_text("v 0 0 0"), "lump.obj was changed after"),
    (lambda folder: (folder / "files.json").write_text("{}"), "holds another model"),
]


@pytest.mark.parametrize(("spoil", "words"), SPOILT, ids=[words for _, words in SPOILT])
def test_a_robot_that_was_moved_or_changed(
    spread: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    """The file that is expected is named, and what to do."""
    robot = read_robot(spread)
    store_robot(robot, tmp_path)
    spoil(tmp_path / FOLDER)
    with pytest.raises(DatasetError, match=words) as raised:
        stored_description(tmp_path, robot.description().to_json())
    assert "import the recordings again with --robot robot.yaml" in str(raised.value)


def test_another_robot_is_not_put_over_it(model: Path, tmp_path: Path) -> None:
    """A dataset has one robot."""
    store_robot(read_robot(written(model)), tmp_path)
    other = derive_robot(model, control_rate_hz=60.0)
    with pytest.raises(DatasetError, match=r"holds another robot: robot.yaml differ; name another folder"):
        store_robot(other, tmp_path)


def test_an_absolute_path_is_refused(spread: Path, tmp_path: Path) -> None:
    """A copy of such a model would follow the original."""
    model = spread.parent / "arm.xml"
    away = (spread.parent.parent / "meshes").as_posix()
    model.write_text(model.read_text(encoding="utf-8").replace("../meshes", away), encoding="utf-8")
    dataset = tmp_path / "dataset"
    dataset.mkdir()
    with pytest.raises(ConfigurationError, match="by an absolute path, so the dataset cannot hold a copy"):
        store_robot(read_robot(spread), dataset)
    assert not list(dataset.iterdir())


def simulated(model: Path, latency_s: float = 0.0) -> tuple[SimulatedRobot, VirtualClock]:
    """Return an arm at its nominal values."""
    clock = VirtualClock(10**9)
    description = derive_robot(model, control_rate_hz=50.0, state_rate_hz=100.0).description()
    truth = SimulatedTruth(parameters={}, latency_s=latency_s, seed=0)
    return SimulatedRobot(load_model(description), ParameterSpace([]), truth, clock), clock


def command(robot: SimulatedRobot, target: float) -> JointCommand:
    """Return a command of the robot's own gains."""
    d, zero = robot.description, np.zeros(2)
    return JointCommand(
        position_target=np.full(2, target),
        velocity_target=zero,
        stiffness=np.array(d.stiffness),
        damping=np.array(d.damping),
        effort=zero,
        effort_limit=np.array(d.effort_limit),
        speed_limit=np.array(d.speed_limit),
    )


@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_a_simulated_robot_moves_when_the_command_acts(model: Path, latency_s: float) -> None:
    """Before the latency is over nothing has changed; samples come at their rate, on both clocks."""
    still, still_clock = simulated(model)
    moved, clock = simulated(model, latency_s)
    for robot in (still, moved):
        robot.home(1.0)
        robot.arm(1.0)
    assert moved.read_state(1.0).status == Status.ARMED
    still.read_state(1.0)
    moved.send_command(command(moved, 0.5))
    for number in range(1, 8):
        state, other = moved.read_state(1.0), still.read_state(1.0)
        assert state.device_ns == clock.now_ns() == 10**9 + (number + 1) * 10_000_000
        assert (state.sequence, state.command_sequence) == (number, 0)
        same = np.array_equal(state.position, other.position)
        assert same == (number * 0.01 <= latency_s)
    with pytest.raises(TransportTimeoutError):
        moved.read_state(0.001)
    moved.passive()
    assert Status.ARMED not in moved.read_state(1.0).status
    assert still_clock.now_ns() < clock.now_ns()


def test_hidden_parameters(model: Path) -> None:
    """A seed gives one truth, inside the middle of the ranges."""
    space = default_space(derive_robot(model, control_rate_hz=50.0).description())
    truth = draw_truth(space, 3, 1.5, 0.004)
    assert truth == draw_truth(space, 3, 1.5, 0.004) != draw_truth(space, 4, 1.5, 0.004)
    for parameter in space:
        ratio = truth.parameters[parameter.name] / parameter.nominal
        assert 1 / 1.5 < ratio < 1.5 and not math.isclose(ratio, 1.0)
    assert truth.to_json()["latency_s"] == 0.004
