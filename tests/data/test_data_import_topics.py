"""Bags of ROS 2 and episodes of ours: which topic is what, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2.writer import Writer

from deal_hw.cli.data import Import, data
from deal_hw.data.importing import mcap_source
from deal_hw.data.importing.columns import parse_column_map
from deal_hw.data.importing.load import load_tables, tables_of
from deal_hw.data.importing.memory_source import read_memory
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.table import table_of
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.reading import parse_yaml
from deal_hw.types import Trajectory

LINE = "=" * 80 + "\nMSG: "
TIME = LINE + "builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = LINE + "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + TIME
DURATION = LINE + "builtin_interfaces/Duration\nint32 sec\nuint32 nanosec\n"
POINT = (
    LINE
    + "trajectory_msgs/JointTrajectoryPoint\nfloat64[] positions\nfloat64[] velocities\n"
    + "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start\n"
    + DURATION
)
DIMENSION = LINE + "std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
LAYOUT = LINE + "std_msgs/MultiArrayLayout\nMultiArrayDimension[] dim\nuint32 data_offset\n" + DIMENSION
DEFINITIONS = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort\n" + HEADER,
    "trajectory_msgs/msg/JointTrajectory": "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint[] points\n" + HEADER + POINT,
    "control_msgs/msg/JointTrajectoryControllerState": "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint reference\ntrajectory_msgs/JointTrajectoryPoint feedback\n"
    + HEADER
    + POINT,
    "std_msgs/msg/Float64MultiArray": "std_msgs/MultiArrayLayout layout\nfloat64[] data\n" + LAYOUT,
}
STATE, TRAJECTORY, CONTROLLER, ARRAY = DEFINITIONS
START_NS = 1_760_000_000_000_000_000
PERIOD_NS = 10_000_000
Rows = Sequence[tuple[str, str, Mapping[str, Any]]]


def stamp(number: int, late_ns: int = 0) -> dict[str, Any]:
    """Return a header, 1 ms before the recorder gets the message."""
    ns = START_NS + number * PERIOD_NS - 1_000_000 + late_ns
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": ""}


def joint_state(number: int, names: Sequence[str], values: Sequence[float]) -> dict[str, Any]:
    """Return a JointState."""
    header = stamp(number)
    return {"header": header, "name": list(names), "position": list(values), "velocity": [], "effort": []}


def point(values: Sequence[float]) -> dict[str, Any]:
    """Return a JointTrajectoryPoint."""
    nothing: dict[str, Any] = {"velocities": [], "accelerations": [], "effort": []}
    return {"positions": list(values), **nothing, "time_from_start": {"sec": 0, "nanosec": 5_000_000}}


def bag(path: Path, messages: Sequence[Rows]) -> Path:
    """Write one row of (topic, type, message) every 10 ms."""
    with open(path, "wb") as file:
        writer = Writer(file)
        schemas: dict[str, Any] = {}
        for number, rows in enumerate(messages):
            for topic, kind, message in rows:
                if kind not in schemas:
                    schemas[kind] = writer.register_msgdef(kind, DEFINITIONS[kind])
                ns = START_NS + number * PERIOD_NS
                writer.write_message(topic, schemas[kind], message, ns, ns, number)
        writer.finish()
    return path


def command(kind: str, number: int, names: Sequence[str], values: Sequence[float]) -> dict[str, Any]:
    """Return a command of any type."""
    if kind == STATE:
        return joint_state(number, names, values)
    if kind == ARRAY:
        return {"layout": {"dim": [{"label": "j", "size": 2, "stride": 2}], "data_offset": 0}, "data": values}
    named = {"header": stamp(number), "joint_names": list(names)}
    if kind == TRAJECTORY:
        return {**named, "points": [point(values)]}
    return {**named, "reference": point(values), "feedback": point([0.0] * len(values))}


TOPICS = {
    STATE: "/joint_commands",
    ARRAY: "/position_controller/commands",
    TRAJECTORY: "/jtc/joint_trajectory",
    CONTROLLER: "/jtc/controller_state",
}


@settings(max_examples=30, deadline=None)
@given(
    kind=st.sampled_from(list(DEFINITIONS)),
    values=st.lists(st.tuples(*[st.floats(-3, 3, allow_nan=False)] * 4), min_size=3, max_size=12),
    names=st.permutations(["hip_joint", "knee_joint"]),
)
def test_measured_and_sent_are_found(
    kind: str,
    values: list[tuple[float, ...]],
    names: list[str],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Whatever type commands have, and whatever order joints: names are followed, else the state's order."""
    rows = [
        [
            ("/joint_states", STATE, joint_state(number, names, each[:2])),
            (TOPICS[kind], kind, command(kind, number, names, each[2:])),
        ]
        for number, each in enumerate(values)
    ]
    path = bag(tmp_path_factory.mktemp("bag") / "bag.mcap", rows)
    reported: list[str] = []
    (table,) = load_tables(path, joints=("hip_joint", "knee_joint"), say=reported.append)
    order = [names.index(name) for name in ("hip_joint", "knee_joint")]
    table_ = np.array(values)
    np.testing.assert_array_equal(table.position, table_[:, :2][:, order])
    np.testing.assert_array_equal(table.target, table_[:, 2:][:, order])
    np.testing.assert_allclose(table.time_s, 0.01 * np.arange(len(values)), atol=1e-9)
    # An array has no header, so its times and those that it is compared with are the recorder's.
    np.testing.assert_allclose(table.command_s, table.time_s, atol=1e-9)
    whole = "\n".join(reported)
    assert "guessed" in whole and TOPICS[kind] in whole and 'position: "/joint_states.position"' in whole


def states(number: int, topic: str = "/joint_states") -> tuple[str, str, dict[str, Any]]:
    """Return a row of measured positions."""
    return topic, STATE, joint_state(number, ("hip", "knee"), (0.1, 0.2))


def commands(number: int, kind: str = ARRAY, topic: str = "") -> tuple[str, str, dict[str, Any]]:
    """Return a row of commands."""
    return topic or TOPICS[kind], kind, command(kind, number, ("hip", "knee"), (0.1, 0.2))


def suggested(text: str) -> Any:
    """Return the column map that a refusal suggests."""
    found = re.search(r"such as (\{.*\})|channel: (\{.*\})", text)
    assert found is not None
    return parse_yaml(found[1] or found[2])


def test_an_arm_and_its_gripper_are_merged_by_name(tmp_path: Path) -> None:
    """Each publishes its own joints, the gripper at half the rate; the arm's controller commands two."""
    rows: list[Rows] = []
    for number in range(40):
        arm = joint_state(number, ["b", "a"], [number, -number])
        here = [
            ("/joint_states", STATE, arm),
            (TOPICS[ARRAY], ARRAY, command(ARRAY, number, [], [number + 1, 7])),
        ]
        if number % 2 == 0:
            here.append(("/joint_states", STATE, joint_state(number, ["finger"], [0.1 * number])))
        rows.append(here)
    said: list[str] = []
    (table,) = load_tables(bag(tmp_path / "b.mcap", rows), joints=("a", "b"), say=said.append)
    assert "a, b: 40; finger: 20 messages): they are merged by name" in said[0]
    np.testing.assert_array_equal(table.position, np.stack([-np.arange(40), np.arange(40)], axis=1))
    np.testing.assert_array_equal(table.target, np.stack([np.full(40, 7), np.arange(40) + 1], axis=1))
    found = mcap_source.read_mcap(tmp_path / "b.mcap")
    assert found.labels["/joint_states.position"] == ("b", "a", "finger")
    np.testing.assert_allclose(found.arrays["/joint_states.position"][:, 2], 0.1 * np.r_[:39, 38], atol=1e-9)


def test_velocities_of_some_messages_are_left_out_with_a_note(tmp_path: Path) -> None:
    """A driver that reports no velocity now and then has none."""
    rows = [
        [("/joint_states", STATE, {**joint_state(k, ["a"], [k]), "velocity": [1.0] if k % 4 else []})]
        for k in range(8)
    ]
    found = mcap_source.read_mcap(bag(tmp_path / "b.mcap", rows))
    assert "/joint_states.velocity" not in found.arrays
    assert found.notes == ("/joint_states.velocity is left out: 2 of 8 messages have 0 values, others 1",)


@pytest.mark.parametrize("second", ["another", "zeros", "joint"])
def test_two_publishers_on_one_topic_are_refused(tmp_path: Path, second: str) -> None:
    """Their joints are alike and their values not."""
    rows: list[Rows] = []
    for number in range(90):
        own = [np.sin(0.05 * number), np.cos(0.03 * number)]
        other = {"another": [0.3, 0.4], "zeros": [0.0, 0.0], "joint": [own[0], 0.2]}[second]
        here: Rows = [
            ("/joint_states", STATE, joint_state(number, ["a", "b"], own)),
            (TOPICS[ARRAY], ARRAY, command(ARRAY, number, [], own)),
        ]
        if number % 2:
            here = [*here, ("/joint_states", STATE, joint_state(number, ["a", "b"], other))]
        rows.append(here)
    path = bag(tmp_path / "b.mcap", rows)
    with pytest.raises(DatasetError, match=r"two sources are interleaved: \d\d% of the samples"):
        load_tables(path)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), noise=st.sampled_from([0.0, 1e-3, 1.0]), steps=st.booleans())
def test_one_source_is_not_taken_for_two(seed: int, noise: float, steps: bool) -> None:
    """Neither smooth motion, nor noise, nor a joint that jumps between two places is two sources."""
    rng = np.random.default_rng(seed)
    time = np.arange(400) / 100
    motion = np.sin(np.outer(time, rng.uniform(1, 60, 2)) + rng.uniform(0, 6, 2))
    position = (np.sign(motion) if steps else motion) + rng.normal(0, noise, motion.shape)
    values = {"time": time, "position": position, "target": position, "joints": ["a", "b"]}
    (table,) = tables_of([read_memory(values, "r")])
    assert table.joint_names == ("a", "b")


def test_a_controllers_state_comes_before_its_goals(tmp_path: Path) -> None:
    """The servos' commands are the reference; the goal says where a segment ends."""
    rows = [[states(n), commands(n, CONTROLLER), commands(n, TRAJECTORY)] for n in range(5)]
    reported: list[str] = []
    load_tables(bag(tmp_path / "bag.mcap", rows), say=reported.append)
    assert any('target: "/jtc/controller_state.reference.positions"' in line for line in reported)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            lambda n: [states(n)],
            r"no topic contains commands for hip, knee; topics: /joint_states \(JointState\)",
        ),
        (
            lambda n: [states(n), states(n, "/left/joint_states"), commands(n)],
            r"2 topics may contain the measured positions \(/joint_states\.position: hip, knee; /left/",
        ),
        (
            lambda n: [states(n), commands(n), commands(n, topic="/effort_controller/commands")],
            r"2 topics may contain the commands",
        ),
    ],
)
def test_what_cannot_be_told_says_what_to_write(
    tmp_path: Path, rows: Callable[[int], Rows], words: str
) -> None:
    """No commands, two topics of either kind: refused in one line, with a column map that reads."""
    path = bag(tmp_path / "bag.mcap", [rows(n) for n in range(5)])
    with pytest.raises(DatasetError, match=words) as caught:
        load_tables(path)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 600 + len(str(path))
    columns = parse_column_map(suggested(text))
    assert columns.position is not None and columns.target is not None


def test_the_suggested_map_reads_the_bag(tmp_path: Path) -> None:
    """With the names put in, the map of the refusal is the map of the file."""
    rows = [[states(n), states(n, "/left/joint_states"), commands(n)] for n in range(5)]
    path = bag(tmp_path / "bag.mcap", rows)
    with pytest.raises(DatasetError) as caught:
        load_tables(path)
    wanted = suggested(str(caught.value))
    topic = "/position_controller/commands"
    wanted |= {"target": f"{topic}.data", "command_time": f"{topic}.log_time", "joints": ["a", "b"]}
    for number, name in enumerate(("hip", "knee")):
        wanted["joints"][number] = {"name": wanted["joints"][number], "column": name, "index": number}
    (table,) = load_tables(path, parse_column_map(wanted))
    assert table.joint_names == ("a", "b") and table.target[0].tolist() == [0.1, 0.2]


def test_joints_by_other_names(tmp_path: Path) -> None:
    """The model's names and the bag's stand side by side in what is to be written."""
    path = bag(tmp_path / "bag.mcap", [[states(n), commands(n)] for n in range(5)])
    with pytest.raises(DatasetError, match=r"which of the model's joints \(a, b\)") as caught:
        load_tables(path, joints=("a", "b"))
    assert "joints: [{name: a, column: hip}, {name: b, column: knee}]" in str(caught.value)


def test_trajectories_of_several_points_are_refused(tmp_path: Path) -> None:
    """The controller interpolates between them: its state has the servos' commands."""
    message = {"header": stamp(0), "joint_names": ["hip", "knee"], "points": [point((0, 0)), point((1, 1))]}
    rows = [[states(n), (TOPICS[TRAJECTORY], TRAJECTORY, message)] for n in range(5)]
    with pytest.raises(DatasetError, match="controller_state"):
        load_tables(bag(tmp_path / "bag.mcap", rows))


def test_long_lists_of_messages_are_refused(tmp_path: Path) -> None:
    """Each point of a trajectory takes twenty times its bytes in memory."""
    topic, kind, message = commands(0, TRAJECTORY)
    long = {**message, "header": {**message["header"], "frame_id": "x" * mcap_source.LIST_BYTES}}
    path = bag(tmp_path / "bag.mcap", [[states(0), (topic, kind, long)]])
    with pytest.raises(DatasetError, match="a message of more than"):
        load_tables(path)


def test_folder_of_a_bag(tmp_path: Path) -> None:
    """What `ros2 bag record` leaves is a folder with metadata.yaml."""
    (tmp_path / "bag").mkdir()
    bag(tmp_path / "bag" / "bag_0.mcap", [[states(n), commands(n)] for n in range(5)])
    with pytest.raises(DatasetError, match=r"a ROS 2 bag \(metadata\.yaml beside \.mcap or \.db3 files\)"):
        load_tables(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (table,) = load_tables(tmp_path / "bag")
    assert table.joint_names == ("hip", "knee")


def test_our_own_episode_reads_as_any_file(write_episode: Callable[..., Path]) -> None:
    """Samples on device time, commands where they came into force, units kept, joints renamed by a map."""
    path = write_episode()
    reported: list[str] = []
    (table,) = load_tables(path, say=reported.append)
    assert table.joint_names == ("cart", "pole") and table.units == ("m", "rad") and reported
    np.testing.assert_allclose(table.time_s, 0.005 * np.arange(600), atol=1e-9)
    # Command n is received 1 ms before the first sample of cycle n + 1.
    np.testing.assert_allclose(table.command_s[:3], [0.019, 0.039, 0.059], atol=1e-9)
    np.testing.assert_allclose(table.target[:3, 0], [0.09, 0.091, 0.092])
    columns = parse_column_map(
        {
            "time": "time_s",
            "command_time": "command_time_s",
            "position": "position",
            "target": "target",
            "joints": [{"name": "slider", "column": "cart", "sign": -1, "unit": "m"}],
        }
    )
    (renamed,) = load_tables(path, columns)
    np.testing.assert_allclose(renamed.position[:, 0], -table.position[:, 0])


def test_efforts_that_nobody_measured_are_no_channel(make_trajectory: Callable[..., Trajectory]) -> None:
    """An import without efforts has NaN there; importing that again must not warn of it."""
    measured = make_trajectory()
    nothing = make_trajectory(effort=np.full(measured.effort.shape, np.nan))
    assert table_of(nothing).effort is None and table_of(measured).effort is not None


def test_our_own_episodes_are_taken_in_as_they_are(
    write_episode: Callable[..., Path], tmp_path: Path
) -> None:
    """A file or a dataset of ours goes into another dataset byte by byte; another robot's does not."""
    path, out = write_episode(), tmp_path / "out"
    assert data(Import(paths=(path,), out=out, force=True)) == 0
    dataset = Dataset.open(out)
    assert dataset.path(0).read_bytes() == path.read_bytes()
    assert dataset.description["name"] == "cartpole"
    assert data(Import(paths=(out,), out=tmp_path / "both", force=True)) == 0
    assert (tmp_path / "both" / "episodes" / "000000.mcap").read_bytes() == path.read_bytes()
    with pytest.raises(ConfigurationError, match=r"name.*the episodes contain their own description"):
        data(Import(paths=(path,), out=out, name="other", force=True))
