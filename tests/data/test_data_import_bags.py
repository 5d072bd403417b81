"""ROS 2 bags in SQLite and in several files, and the map that a robot.yaml of ros2_control gives them."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from ros2_rig import COMMANDS, Ros2Rig

from deal_hw.data.importing.bag_source import read_bag
from deal_hw.data.importing.load import load_tables
from deal_hw.data.recording.dataset import Dataset
from deal_hw.data.recording.reader import read_trajectory
from deal_hw.data.recording.schemas import (
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    RosMessageType,
)
from deal_hw.errors import DatasetError
from deal_hw.workflows.import_export import ImportSettings, import_recordings

Row = tuple[str, str, int, bytes]
"""Topic, type, time of receipt [ns], bytes."""
START_NS = 1_760_000_000_000_000_000
KINDS = {"position": FLOAT64_MULTI_ARRAY, "trajectory": JOINT_TRAJECTORY}


def write_db3(path: Path, rows: Sequence[Row], definitions: Sequence[RosMessageType] = ()) -> Path:
    """Write a bag's file as rosbag2_storage_sqlite3 does; definitions are in it since ROS 2 Iron."""
    database = sqlite3.connect(path)
    database.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL);"
    )
    if definitions:
        database.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, "
            "encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, "
            "type_description_hash TEXT NOT NULL)"
        )
        for kind in definitions:
            database.execute(
                "INSERT INTO message_definitions VALUES(NULL, ?, 'ros2msg', ?, '')",
                (kind.name, kind.definition),
            )
    topics = list(dict.fromkeys((topic, name) for topic, name, _, _ in rows))
    for number, (topic, name) in enumerate(topics, 1):
        database.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (number, topic, name))
    for topic, name, stamp_ns, data in rows:
        number = 1 + topics.index((topic, name))
        database.execute("INSERT INTO messages VALUES(NULL, ?, ?, ?)", (number, stamp_ns, data))
    database.commit()
    database.close()
    return path


def recorded(rig: Ros2Rig, seconds: float = 4.0) -> list[Row]:
    """Drive the robot and return the messages on its topics, as a recorder receives them."""
    rig.armed()
    rig.robot.take_wire()
    rows: list[Row] = []
    names = {
        "rx": (f"/{rig.section.state_topic}", JOINT_STATE),
        "tx": (f"/{rig.section.command_topic}", KINDS[rig.section.command]),
    }
    for cycle in range(round(50 * seconds)):
        rig.run(1, target=0.6 * np.sin(0.15 * cycle))
        for message in rig.robot.take_wire():
            topic, kind = names[message.channel]
            rows.append((topic, kind.name, START_NS + message.stamp_ns, message.payload))
    return rows


@pytest.fixture(params=COMMANDS)
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Ros2Rig:
    """A robot with either controller, whose joints have another order and another name in ROS."""
    return Ros2Rig(tmp_path, request.param)


def test_robot_yaml_says_what_a_bag_is(rig: Ros2Rig, tmp_path: Path) -> None:
    """The commands of a Float64MultiArray are in the controller's order, and no guess gets that right."""
    rows = recorded(rig)
    path = write_db3(tmp_path / "bag.db3", rows)
    settings = ImportSettings(paths=(path,), out=tmp_path / "data", robot=tmp_path / "robot.yaml")
    dataset = import_recordings(settings)
    assert isinstance(dataset, Dataset)
    trajectory = read_trajectory(dataset.path(0))
    assert trajectory.joint_names == ("shoulder", "elbow")
    target = trajectory.position_target
    # Both joints get the same target, so the names alone tell them apart: compare with what was measured.
    np.testing.assert_allclose(target[:, 0], target[:, 1])
    channels = read_bag(path)
    order = [channels.labels["/joint_states.position"].index(name) for name in ("shoulder", "elbow_joint")]
    measured = channels.arrays["/joint_states.position"][:, order]
    assert trajectory.position.shape[0] == pytest.approx(len(measured), abs=3)
    np.testing.assert_allclose(trajectory.position.max(axis=0), measured.max(axis=0), atol=0.02)
    np.testing.assert_allclose(trajectory.velocity.std(axis=0), 0.6 * 7.5 / np.sqrt(2), rtol=0.3)


def test_commands_in_the_controllers_order(tmp_path: Path) -> None:
    """Elbow first, though the states have it last or by another name."""
    rig = Ros2Rig(tmp_path)
    rows = recorded(rig, 0.5)
    data = [
        (topic, kind, at, FLOAT64_MULTI_ARRAY.encode(0, 0, [0.25, -0.5]) if "commands" in topic else payload)
        for topic, kind, at, payload in rows
    ]
    path = write_db3(tmp_path / "bag.db3", data)
    from deal_hw.sim.robots.robot_file import read_robot_file
    from deal_hw.workflows.ros2_columns import columns_of_robot

    file = read_robot_file(tmp_path / "robot.yaml")
    assert file.ros2 is not None
    section = file.ros2
    (table,) = load_tables(path, lambda channels: columns_of_robot(file, section, channels))
    assert table.joint_names == ("shoulder", "elbow")
    np.testing.assert_array_equal(np.unique(table.target, axis=0), [[-0.5, 0.25]])


def test_other_topics_are_guessed(tmp_path: Path) -> None:
    """A bag of another namespace: the map is guessed as without a robot.yaml."""
    rig = Ros2Rig(tmp_path, "trajectory", joints=(), names={})
    rows = [(f"/left{topic}", kind, at, data) for topic, kind, at, data in recorded(rig)]
    path = write_db3(tmp_path / "bag.db3", rows)
    said: list[str] = []
    settings = ImportSettings(paths=(path,), out=tmp_path / "data", robot=tmp_path / "robot.yaml")
    assert import_recordings(settings, said.append) is not None
    assert any("this one was guessed" in text for text in said)


def test_a_bag_in_several_files(tmp_path: Path) -> None:
    """`ros2 bag record --max-bag-duration` splits it; SQLite and a definition in the bag itself."""
    rig = Ros2Rig(tmp_path, "trajectory", joints=(), names={})
    rows = recorded(rig, 2.0)
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    half = len(rows) // 2
    write_db3(folder / "bag_0.db3", rows[:half], [JOINT_STATE, JOINT_TRAJECTORY])
    write_db3(folder / "bag_1.db3", rows[half:])
    (table,) = load_tables(folder)
    (whole,) = load_tables(write_db3(tmp_path / "whole.db3", rows))
    np.testing.assert_array_equal(table.time_s, whole.time_s)
    np.testing.assert_array_equal(table.target, whole.target)
    (folder / "bag_2.db3.zstd").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"compressed bag \(bag_2\.db3\.zstd\)"):
        load_tables(folder)


def test_topics_without_a_definition_are_left_out(tmp_path: Path) -> None:
    """A note says so; the joints are read all the same."""
    rig = Ros2Rig(tmp_path, "trajectory", joints=(), names={})
    rows = [*recorded(rig, 1.0), ("/camera", "sensor_msgs/msg/Image", START_NS, b"\0\1\0\0")]
    path = write_db3(tmp_path / "bag.db3", rows)
    said: list[str] = []
    (table,) = load_tables(path, say=said.append)
    assert table.joint_names == ("elbow", "shoulder")
    assert any("/camera is left out: the bag holds no definition of sensor_msgs/msg/Image" in s for s in said)


def corrupt(path: Path) -> None:
    """Change bytes in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 4096] = bytes(4096)
    path.write_bytes(data)


def as_view(path: Path) -> None:
    """Replace the messages by a view, which computes for ever."""
    database = sqlite3.connect(path)
    database.executescript(
        "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL "
        "SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00010000' AS data FROM n;"
    )
    database.close()


def changed(statement: str) -> Callable[[Path], None]:
    """Return a function that runs a statement on a file."""

    def change(path: Path) -> None:
        database = sqlite3.connect(path)
        database.executescript(statement)
        database.close()

    return change


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda path: path.write_bytes(b""), "it is no file of a bag"),
        (lambda path: path.write_bytes(b"SQLite format 3\0" + b"x" * 500), "cannot be read as a bag"),
        (corrupt, "bag.db3"),
        (as_view, "its tables are topics, not those of a bag"),
        (changed("DROP TABLE topics"), "its tables are messages"),
        (changed("UPDATE messages SET data = 'text'"), "is no message"),
        (changed("UPDATE messages SET data = x'28B52FFD00'"), "its messages are compressed"),
        (changed("UPDATE messages SET data = x'0001'"), "bag.db3"),
        (changed("UPDATE topics SET serialization_format = 'json'"), "not in ROS 2's CDR"),
    ],
)
def test_damaged_and_hostile_files_are_one_line(
    tmp_path: Path, damage: Callable[[Path], None], told: str
) -> None:
    """Each names the file; none computes for ever."""
    rig = Ros2Rig(tmp_path, "trajectory", joints=(), names={})
    path = write_db3(tmp_path / "bag.db3", recorded(rig, 1.0))
    damage(path)
    with pytest.raises(DatasetError, match=re.escape(told)) as caught:
        load_tables(path)
    assert "bag.db3" in str(caught.value) and "\n" not in str(caught.value)
