"""Files of other people's loggers, read into tables."""

from __future__ import annotations

import csv
import gzip
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from deal_hw.data.importing.columns import parse_column_map, read_column_map
from deal_hw.data.importing.csv_source import read_csv
from deal_hw.data.importing.load import is_episode, load_tables, read_channels
from deal_hw.data.importing.mcap_source import read_mcap
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.data.importing.table import build_table
from deal_hw.data.recording import schemas
from deal_hw.data.recording.schemas import RosMessageType
from deal_hw.errors import ConfigurationError, DatasetError, UnknownNameError

JOINT_STATE = RosMessageType(
    "sensor_msgs/msg/JointState",
    (("int64", "tick"), ("string[]", "name"), ("float64[]", "position"), ("float64[]", "velocity")),
)


def write(path: Path, text: str) -> Path:
    """Write a text file and return its path."""
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_named_like_the_joints_needs_no_map(tmp_path: Path) -> None:
    """Time in ms by name, degrees by name, order of the model; the guess is reported."""
    path = write(
        tmp_path / "rec.csv",
        "time_ms,elbow_cmd,elbow_pos_deg,Shoulder.pos,shoulder_target,shoulder_vel,note\n"
        "0,0.1,90,1.0,1.5,7,start\n"
        "10,0.2,180,2.0,2.5,8,\n"
        "20,0.3,270,3.0,3.5,9,end\n",
    )
    reported: list[str] = []
    (table,) = load_tables(path, joints=("shoulder_joint", "elbow"), say=reported.append)
    assert table.joint_names == table.actuated == ("shoulder_joint", "elbow")
    np.testing.assert_allclose(table.time_s, [0.0, 0.01, 0.02], atol=1e-15)
    np.testing.assert_allclose(table.position, [[1, np.pi / 2], [2, np.pi], [3, 1.5 * np.pi]])
    np.testing.assert_allclose(table.target[:, 0], [1.5, 2.5, 3.5])
    assert table.velocity is not None and np.isnan(table.velocity[:, 1]).all()
    assert table.velocity[:, 0].tolist() == [7, 8, 9]
    whole = "\n".join(reported)
    for words in (
        "text are left out: note",
        "guessed",
        '"time_ms", unit: ms',
        "elbow_pos_deg",
        'unit: "deg"',
    ):
        assert words in whole
    assert table.source["sha256"] and table.source["columns"] == ["guessed"]


def test_csv_without_a_model_names_joints_by_its_columns(tmp_path: Path) -> None:
    """Columns with a word for position or a partner with a word for target are joints, others are not."""
    path = write(tmp_path / "r.csv", "t,q_A,des_A,B,B_ref,temperature\n0,1,2,3,4,50\n1,1,2,3,4,50\n")
    (table,) = load_tables(path)
    assert table.joint_names == ("A", "B")
    assert table.position.tolist() == [[1, 3], [1, 3]] and table.target.tolist() == [[2, 4], [2, 4]]


def test_csv_dialects(tmp_path: Path) -> None:
    """Semicolons with decimal commas, a comment, a byte-order mark, empty cells, a torn last row."""
    text = "﻿# made by a logger\nt;a;b\n0,5;1,25;\n1,5;nan;3\n2,5;4;5\n3,5;6"
    channels = read_csv(write(tmp_path / "r.csv", text))
    assert channels.arrays["t"].tolist() == [0.5, 1.5, 2.5]
    np.testing.assert_array_equal(channels.arrays["a"], [1.25, np.nan, 4])
    np.testing.assert_array_equal(channels.arrays["b"], [np.nan, 3, 5])
    assert "line 6 is incomplete" in channels.notes[0]


NAMES = "time,a_pos,a_cmd"
ROWS = ["0.00,0.5,0.25", "0.01,-1.5,2", "0.02,1e-3,3.5"]


def dialect(text: str, delimiter: str = ",", point: str = ".", encoding: str = "utf-8") -> bytes:
    """Return a table in another dialect of CSV."""
    return text.replace(".", point).replace(",", delimiter).replace("~", ",").encode(encoding)


@pytest.mark.parametrize(
    ("data", "note"),
    [
        (dialect("\n".join([NAMES, *ROWS]), "  "), ""),
        (dialect("\n".join([NAMES, *ROWS]), "\t", "~"), ""),
        (dialect("\r\n".join([NAMES, *ROWS]), "|"), ""),
        (dialect("\n".join([NAMES, *ROWS]), " ", "~"), ""),
        (dialect("\n".join([NAMES, *ROWS]), ";", "~", "utf-16"), ""),
        (dialect("\n".join([NAMES, *ROWS]), "\t", "~", "utf-16-be"), ""),
        (dialect("\n".join(["sep=;", NAMES, *ROWS]), ";"), ""),
        (dialect("\n".join([f"# {NAMES}", *ROWS]), " "), ""),
        (dialect("\n".join([f"% {NAMES}", *ROWS])), ""),
        (dialect("\n".join([f"{NAMES},", *(f"{row}," for row in ROWS)])), ""),
        (dialect("\n".join(["Logger v2", "Date 30-11-2026", "", NAMES, *ROWS])), "left out: Logger v2; Date"),
        (dialect("\n".join(["Logger,,", ",,", NAMES, *ROWS])), "before line 3, which names the columns"),
        (dialect("\n".join([NAMES, "[s],[rad],[rad]", *ROWS])), "line 2 holds the units: s, rad, rad"),
        (gzip.compress(dialect("\n".join([NAMES, *ROWS])), mtime=0), ""),
    ],
)
def test_csv_of_any_logger(tmp_path: Path, data: bytes, note: str) -> None:
    """Delimiters, decimal commas, encodings and lines before the rows all give the same recording."""
    (tmp_path / "r.csv").write_bytes(data)
    said: list[str] = []
    (table,) = load_tables(tmp_path / "r.csv", say=said.append)
    np.testing.assert_allclose(table.time_s, [0, 0.01, 0.02], atol=1e-15)
    assert table.position.ravel().tolist() == [0.5, -1.5, 1e-3]
    assert table.target.ravel().tolist() == [0.25, 2, 3.5]
    assert note in "\n".join(said)


@pytest.mark.parametrize(
    ("times", "steps"),
    [
        (["2026-11-30T23:59:59.995", "2026-12-01T00:00:00.005", "2026-12-01T00:00:00.015"], [0, 0.01, 0.02]),
        (["2026-11-30 12:00:00.000000001Z", "2026-11-30 12:00:00.000000002Z"], [0, 1e-9]),
        (["2026-11-30T12:00:00+01:00", "2026-11-30T11:00:00.5Z"], [0, 0.5]),
        (["23:59:59.990", "00:00:00", "0:00:00.01"], [0, 0.01, 0.02]),
        (["11:59:59.5 AM", "12:00:00.0 PM", "01:00:00 PM"], [0, 0.5, 3600.5]),
        (["31.12.2026 23:59:59", "01.01.2027 00:00:00.25"], [0, 1.25]),
        (["0 days 00:00:01.5", "1 days 00:00:01.5"], [0, 86400]),
    ],
)
def test_csv_with_times_of_day(tmp_path: Path, times: list[str], steps: list[float]) -> None:
    """Dates, times of day beyond midnight, time zones and halves of a day become seconds."""
    rows = "\n".join(f"{time},{k}.5,1" for k, time in enumerate(times))
    path = write(tmp_path / "r.csv", f"Zeit,a_pos,a_cmd\n{rows}\n")
    said: list[str] = []
    (table,) = load_tables(path, say=said.append)
    np.testing.assert_allclose(table.time_s, steps, rtol=0, atol=5e-11)
    assert f"the times of 'Zeit', such as '{times[0]}', are read as seconds" in said[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,a\n03/04/2026 12:00:00,1\n03/05/2026 12:00:00,2\n", "not a time: the date 03/05/2026 may be"),
        ("time,a\n12:00:00,1\n12:xx,2\n", "line 3, column 'time' contains '12:xx', not a time"),
        ("t,a\n0,x\n1,2\n2,3\n", "line 2, column 'a' contains 'x', not a number"),
        ("t,a\n0,00,1,5\n0,01,2,5\n", "has 4 cells, but the header in line 1 has 2.*decimal commas"),
        ("time,a_pos,a_cmd\ns,rev,rev\n0,1,2\n", "the unit of 'a_pos' is 'rev'; known are rad, deg, m, mm"),
    ],
)
def test_csv_that_cannot_be_told(tmp_path: Path, text: str, words: str) -> None:
    """The date, the cell, the delimiter or the unit is named."""
    with pytest.raises(DatasetError, match=words):
        load_tables(write(tmp_path / "r.csv", text))


@pytest.mark.parametrize(
    ("header", "position", "seconds"),
    [
        ("time [ms];a_pos [°];a_cmd [°]", np.pi / 180, 1e-3),
        ("Timestamp(us);a_pos (deg);a_cmd (deg)", np.pi / 180, 1e-6),
        ("t_ns;a_pos;a_cmd", 1, 1e-9),
        ("elapsed_time [s];a_pos[rad];a_cmd[rad]", 1, 1),
        ("Zeit;a_pos;a_cmd\n(ms);(deg);(deg)", np.pi / 180, 1e-3),
    ],
)
def test_csv_units_in_brackets(tmp_path: Path, header: str, position: float, seconds: float) -> None:
    """A unit behind a name, or in a line below the names, is that of the column."""
    (tmp_path / "r.csv").write_bytes(f"{header}\n0,0;1;2\n0,5;2;3\n1,0;3;4\n".encode("cp1252"))
    (table,) = load_tables(tmp_path / "r.csv", joints=["a"])
    np.testing.assert_allclose(table.time_s, [0, 0.5 * seconds, seconds])
    np.testing.assert_allclose(table.position[:, 0], np.array([1, 2, 3]) * position)
    np.testing.assert_allclose(table.target[:, 0], np.array([2, 3, 4]) * position)


def test_csv_lists_in_cells(tmp_path: Path) -> None:
    """A list in each cell becomes an array; an empty cell a row of NaN."""
    path = write(tmp_path / "r.csv", 't,q\n0,\n1,"[1.0, 2.0]"\n2,"[3.0, 4.0]"\n')
    np.testing.assert_array_equal(read_csv(path).arrays["q"], [[np.nan, np.nan], [1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("1,2\n3,4\n", "must name the columns"),
        ("t,t\n1,2\n", "each once"),
        ("t,a\n0,1\n1,x\n", "line 3, column 'a' contains 'x'"),
        ("t,a\n0,1,2\n", "line 2 has 3 cells"),
        ("t,a\n0\n1,2\n", "line 2 has fewer"),
        ('t,a\n0,"[1,2]"\n1,"[1]"\n', "line 3, column 'a'"),
    ],
)
def test_csv_that_makes_no_sense(tmp_path: Path, text: str, words: str) -> None:
    """Row and column are named, or what the header should be."""
    with pytest.raises(DatasetError, match=words):
        read_csv(write(tmp_path / "r.csv", text))


@settings(max_examples=40, deadline=None)
@given(
    rows=st.lists(
        st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=3, max_size=3), min_size=1
    ),
    delimiter=st.sampled_from(",\t"),
)
def test_csv_round_trip(
    rows: list[list[float]], delimiter: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Whatever the csv module writes of floats reads back bit by bit."""
    out = io.StringIO()
    csv.writer(out, delimiter=delimiter).writerows([["x", "y", "z"], *rows])
    channels = read_csv(write(tmp_path_factory.mktemp("csv") / "r.csv", out.getvalue()))
    back = np.stack([channels.arrays[name] for name in "xyz"], axis=1)
    np.testing.assert_array_equal(back, np.array(rows))


def test_npz_arrays(tmp_path: Path) -> None:
    """Arrays are guessed by label where the file names its joints, else by the model's order."""
    q = np.arange(12.0).reshape(4, 3)
    arrays: dict[str, Any] = {"time": np.arange(4) * 5e6, "dof_pos": q, "des_dof_pos": q + 100}
    np.savez(tmp_path / "a.npz", joint_names=np.array(["hip", "knee", "foot"]), **arrays)
    (table,) = load_tables(tmp_path / "a.npz", joints=("foot_joint", "knee_joint", "hip_joint"))
    np.testing.assert_array_equal(table.position, q[:, ::-1])
    np.testing.assert_array_equal(table.target, q[:, ::-1] + 100)
    np.testing.assert_allclose(table.time_s, [0, 0.005, 0.010, 0.015])  # ns, by the size of its steps.
    np.savez(tmp_path / "b.npz", **arrays)
    (table,) = load_tables(tmp_path / "b.npz", joints=("u", "v", "w"))
    np.testing.assert_array_equal(table.position, q)
    with pytest.raises(DatasetError, match="which joints the 3 columns"):
        load_tables(tmp_path / "b.npz", joints=("u", "v"))


def test_npz_of_other_shapes(tmp_path: Path) -> None:
    """A time of one column is read; an array whose rows are joints, and a batch, are named."""
    time, q = np.arange(6.0)[:, None] / 100, np.arange(12.0).reshape(6, 2)
    path = tmp_path / "a.npz"
    np.savez(path, time=time, dof_pos=q, des_dof_pos=q + 1, joint_names=np.array(["a", "b"]))
    (table,) = load_tables(path)
    np.testing.assert_allclose(table.time_s, time[:, 0])
    np.testing.assert_array_equal(table.target, q + 1)
    np.savez(path, time=time, dof_pos=q.T, des_dof_pos=q.T)
    with pytest.raises(DatasetError, match=r"'dof_pos' has shape \(2, 6\), but there are 6 times.*transpose"):
        load_tables(path, joints=("a", "b"))
    np.savez(path, time=time, dof_pos=q[None], des_dof_pos=q[None])
    with pytest.raises(DatasetError, match=r"dof_pos is left out: float64 \(1, 6, 2\) is a batch; save each"):
        load_tables(path, joints=("a", "b"))


def test_npz_with_several_lists_of_names(tmp_path: Path) -> None:
    """The names of the joints count, whatever other text is in the file; without them none does."""
    time = np.arange(4.0)
    position = np.stack([time, -time], axis=1)
    arrays: dict[str, Any] = {"time": time, "dof_pos": position, "dof_target": np.ones((4, 2))}
    others: dict[str, Any] = {"actuator_names": np.array(["knee", "hip"]), "task": np.array(["walk"])}
    np.savez(tmp_path / "a.npz", joint_names=np.array(["hip", "knee"]), **arrays, **others)
    reported: list[str] = []
    (table,) = load_tables(tmp_path / "a.npz", joints=("hip", "knee"), say=reported.append)
    np.testing.assert_array_equal(table.position, position)
    assert any("actuator_names is left out: not the joints' names" in line for line in reported)
    np.savez(tmp_path / "b.npz", **arrays, **others)
    assert read_npz(tmp_path / "b.npz").joint_names == ()


def test_npz_never_unpickles(tmp_path: Path) -> None:
    """A pickled object is left out with a note; a file of another kind is refused."""
    np.savez(
        tmp_path / "a.npz",
        time=np.arange(3.0),
        bad=np.array([{"a": 1}], dtype=object),
        deep=np.zeros((2, 2, 2)),
    )
    channels = read_npz(tmp_path / "a.npz")
    assert list(channels.arrays) == ["time"]
    assert any("bad is left out" in note for note in channels.notes)
    with pytest.raises(DatasetError, match="cannot be read as NPZ"):
        read_npz(write(tmp_path / "x.npz", "no archive"))
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DatasetError, match="one unnamed array"):
        read_npz(tmp_path / "one.npy")


Other = tuple[str, str, str, str, bytes, bytes]
"""Topic, encoding of messages, type, encoding of its definition, that, and a message."""


def joint_states(path: Path, orders: list[tuple[str, ...]], other: Other | None = None) -> Path:
    """Write JointState-like messages at 10 ms and commands at 20 ms, joints in the given orders."""
    values = {"left": 1.0, "right": 2.0}
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE.name, "ros2msg", JOINT_STATE.definition.encode())
        state = writer.register_channel("/joint_states", "cdr", schema)
        command = writer.register_channel("/joint_command", "cdr", schema)
        if other is not None:
            topic, encoding, kind, language, definition, message = other
            channel = writer.register_channel(
                topic, encoding, writer.register_schema(kind, language, definition)
            )
            writer.add_message(channel, 1_700_000_001_000_000_000, message, 1_700_000_001_000_000_000)
        zero_ns = 1_700_000_000_123_456_789
        for number, order in enumerate(orders):
            position = [values[name] + number for name in order]
            stamp_ns = zero_ns + number * 10_000_000
            data = JOINT_STATE.encode(number, order, position, [0.5] * len(order))
            writer.add_message(state, stamp_ns, data, stamp_ns, number)
            if number % 2 == 0:
                data = JOINT_STATE.encode(number, ("left", "right"), [10.0 + number, 20.0 + number], [])
                writer.add_message(command, stamp_ns + 1000, data, stamp_ns + 1000, number)
        writer.finish()
    return path


def test_mcap_joint_states(tmp_path: Path) -> None:
    """Two topics on their own clocks are guessed; messages with another order of joints are sorted."""
    path = joint_states(
        tmp_path / "bag.mcap", [("left", "right"), ("right", "left"), ("left", "right"), ("right", "left")]
    )
    assert not is_episode(path)
    (table,) = load_tables(path, joints=("right", "left"))
    np.testing.assert_array_equal(table.position, [[2, 1], [3, 2], [4, 3], [5, 4]])
    np.testing.assert_array_equal(table.target, [[20, 10], [22, 12]])
    np.testing.assert_allclose(table.time_s, [0, 0.01, 0.02, 0.03], atol=1e-12)
    np.testing.assert_allclose(table.command_s, [1e-6, 0.020001], atol=1e-12)
    columns = parse_column_map(
        {
            "time": "/joint_states.log_time",
            "command_time": "/joint_command.log_time",
            "joints": [
                {
                    "name": "l",
                    "position": "/joint_states.position[left]",
                    "target": "/joint_command.position[0]",
                }
            ],
        }
    )
    (table,) = load_tables(path, columns)
    assert table.position[:, 0].tolist() == [1, 2, 3, 4] and table.target[:, 0].tolist() == [10, 12]


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (
            ("/x", "json", "Note", "jsonschema", b"{}", b'{"a": 1}'),
            "its messages are json, not in ROS 2's CDR",
        ),
        (
            ("/x", "protobuf", "foxglove.Log", "protobuf", b"\n\xc8\xff", b"\x08\x01"),
            "its messages are proto",
        ),
        (
            ("/x", "cdr", "p/msg/X", "ros2idl", b"module p {};", bytes(12)),
            "its definition is ros2idl, not",
        ),
        (("/x", "cdr", "p/msg/Own", "", b"", bytes(12)), "the bag holds no definition of p/msg/Own"),
        (
            ("/x", "cdr", "p/msg/Own", "ros2msg", b"float64 1x", bytes(12)),
            "its definition cannot be",
        ),
    ],
)
def test_mcap_with_a_topic_of_another_kind(tmp_path: Path, other: Other, why: str) -> None:
    """That topic is left out with the reason; the rest is read."""
    path = joint_states(tmp_path / "bag.mcap", [("left", "right")] * 4, other)
    found = read_mcap(path)
    assert len(found.notes) == 1 and found.notes[0].startswith(f"/x is left out: {why}")
    plain = read_mcap(joint_states(tmp_path / "plain.mcap", [("left", "right")] * 4))
    assert found.arrays.keys() == plain.arrays.keys()
    np.testing.assert_array_equal(found.arrays["/joint_states.position"], [[1, 2], [2, 3], [3, 4], [4, 5]])


def test_mcap_with_a_known_message_needs_no_definition(tmp_path: Path) -> None:
    """JointState is read also where the bag holds only its name, as in SQLite bags of ROS 2 Humble."""
    kind = "sensor_msgs/msg/JointState"
    message = schemas.JOINT_STATE.encode(0, 0, "", ("a",), [0.5], [], [])
    found = read_mcap(joint_states(tmp_path / "b.mcap", [("left",)], ("/x", "cdr", kind, "", b"", message)))
    assert found.notes == () and found.arrays["/x.position"].tolist() == [[0.5]]


def test_what_is_no_mcap_is_refused(tmp_path: Path) -> None:
    """The message says what kind of file was expected."""
    with pytest.raises(DatasetError, match="cannot be read as MCAP"):
        read_mcap(write(tmp_path / "x.mcap", "no mcap"))


def test_column_map_units_signs_and_scales(tmp_path: Path) -> None:
    """Each entry by hand: 90 deg turned and shifted, 50 of 0..100, 20 mm, gyro in deg/s, xyzw, none."""
    path = write(
        tmp_path / "r.csv",
        "us,a_q,a_c,b_q,b_c,b_v,c_q,c_c,x,y,z,w,gx,gy,gz\n"
        "1000000,90,45,50,100,10,20,0.03,0,0,0,1,180,0,0\n"
        "1010000,0,0,0,0,0,0,0,1,0,0,0,0,0,90\n",
    )
    columns = write(
        tmp_path / "map.yaml",
        """
        time: {column: us, unit: us}
        position: "{joint}_q"
        target: "{joint}_c"
        unit: deg
        joints:
          - {name: arm, column: a, sign: -1, offset: 0.25}
          - {name: jaw, column: b, velocity: b_v, normalised: {from: [0, 100], to: [-0.2, 1.8]}}
          - {name: rail, column: c, unit: mm, target_unit: m}
        orientation: {columns: [x, y, z, w], order: xyzw}
        gyro: {columns: [gx, gy, gz], unit: deg}
        """,
    )
    (table,) = load_tables(path, read_column_map(columns), joints=("rail", "arm", "jaw"))
    assert table.joint_names == ("rail", "arm", "jaw") and table.units == ("m", "rad", "rad")
    np.testing.assert_allclose(table.position[0], [0.02, 0.25 - np.pi / 2, 0.8])
    np.testing.assert_allclose(table.target[0], [0.03, 0.25 - np.pi / 4, 1.8])
    np.testing.assert_allclose(table.position[1], [0.0, 0.25, -0.2])
    assert table.velocity is not None
    np.testing.assert_allclose(table.velocity[0], [np.nan, np.nan, 0.2])  # 10 a second of 100 for 2 rad.
    np.testing.assert_allclose(table.time_s, [0.0, 0.01], atol=1e-12)
    assert table.orientation is not None and table.gyro is not None
    np.testing.assert_array_equal(table.orientation, [[1, 0, 0, 0], [0, 1, 0, 0]])
    np.testing.assert_allclose(table.gyro, [[np.pi, 0, 0], [0, 0, np.pi / 2]])


def test_log_of_two_rates_in_one_file(tmp_path: Path) -> None:
    """Rows without a position and rows without a target are left out of the one or the other, and counted."""
    text = "time_s,a_pos,a_cmd\n0,1,10\n1,2,\n2,,20\n3,4,\n"
    (table,) = load_tables(write(tmp_path / "r.csv", text))
    assert table.time_s.tolist() == [0, 1, 3] and table.position[:, 0].tolist() == [1, 2, 4]
    assert table.command_s.tolist() == [0, 2] and table.target[:, 0].tolist() == [10, 20]
    assert (table.source["rows_without_position"], table.source["rows_without_target"]) == (1, 2)


NO_SCALE = {"name": "a", "normalised": {"from": [0, 0], "to": [0, 1]}}
NO_PAIR = {"name": "a", "normalised": {"from": [0]}}
NO_ORDER = {"column": "q", "order": "yxzw"}
HOURS = {"column": "t", "unit": "h"}


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ([], ConfigurationError, "not a mapping"),
        ({"time": "t"}, ConfigurationError, "'joints' is missing"),
        ({"time": "t", "joints": ["a"], "colour": 1}, UnknownNameError, "'colour'"),
        ({"time": HOURS, "joints": ["a"]}, UnknownNameError, "'h'; known: s, ms, us, ns"),
        ({"time": "t", "joints": []}, ConfigurationError, "at least one"),
        ({"time": "t", "joints": ["a", "a"]}, ConfigurationError, "each joint once"),
        ({"time": "t", "joints": [{"column": "a"}]}, ConfigurationError, "has no name"),
        ({"time": "t", "joints": [{"name": "a", "sign": 2}]}, ConfigurationError, "sign is 1 or -1"),
        ({"time": "t", "joints": [{"name": "a", "sign": "x"}]}, ConfigurationError, "sign must be a number"),
        ({"time": "t", "joints": [{"name": "a", "unit": "turns"}]}, UnknownNameError, "'turns'"),
        ({"time": "t", "joints": [NO_SCALE]}, ConfigurationError, "no scale"),
        ({"time": "t", "joints": [NO_PAIR]}, ConfigurationError, "two numbers"),
        (
            {"time": "t", "joints": ["a"], "gyro": {"columns": ["x"] * 2}},
            ConfigurationError,
            "name 3 columns",
        ),
        ({"time": "t", "joints": ["a"], "orientation": NO_ORDER}, UnknownNameError, "wxyz"),
    ],
)
def test_column_map_that_makes_no_sense(values: Any, error: type[Exception], words: str) -> None:
    """Each says what was given and what is allowed."""
    with pytest.raises(error, match=words):
        parse_column_map(values)


def test_column_map_file_runs_nothing(tmp_path: Path) -> None:
    """YAML that would build an object is refused, as is what is no YAML."""
    path = write(tmp_path / "map.yaml", "time: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(ConfigurationError, match="cannot be read as a column map"):
        read_column_map(path)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_column_map(tmp_path / "none.yaml")


def test_column_map_that_does_not_fit_the_file(tmp_path: Path) -> None:
    """A missing channel names the near ones, a wide one its columns, an unknown joint the model's."""
    np.savez(tmp_path / "a.npz", time=np.arange(4.0), q=np.zeros((4, 2)), u=np.zeros((3, 2)))
    (channels,) = read_channels(tmp_path / "a.npz")

    def build(joints: list[Any], model: tuple[str, ...] | None = None, **entries: Any) -> None:
        build_table(channels, parse_column_map({"time": "time", "joints": joints, **entries}), model)

    refused: tuple[tuple[Callable[[], None], str], ...] = (
        (lambda: build(["a"], position="qq"), "no channel 'qq'"),
        (lambda: build([{"name": "a", "position": "q"}]), "has 2 columns"),
        (lambda: build([{"name": "a", "position": "q[5]"}]), "no column '5'"),
        (lambda: build(["a", "b", "c"], position="q"), "would be number 2"),
        (lambda: build(["a", "b"], position="time"), "one channel but there are 2 joints"),
        (lambda: build(["a", "b"], position="q", target="u"), "give `command_time`"),
        (lambda: build(["a", "b"], target="q"), "no position of a, b"),
        (lambda: build(["a", "b"], ("x", "y"), position="q"), "its joints: x, y"),
    )
    for call, words in refused:
        with pytest.raises(DatasetError, match=words):
            call()


def test_columns_that_do_not_exist_are_never_replaced_by_their_place(tmp_path: Path) -> None:
    """Each refusal says what was asked for, what there is, and what to write instead."""
    q = np.arange(8.0).reshape(4, 2)
    names = np.array(["hip", "knee"])
    np.savez(tmp_path / "a.npz", time=np.arange(4.0), q=q, u=q[:, :1], joint_names=names)
    np.savez(tmp_path / "b.npz", time=np.arange(4.0), q=q)
    np.savez(tmp_path / "c.npz", time=np.arange(4.0), q=q, joint_names=np.array(["hip", "hip"]))

    def position(file: str, joints: list[Any], **entries: Any) -> Any:
        (channels,) = read_channels(tmp_path / file)
        columns = parse_column_map({"time": "time", "position": "q", "joints": joints, **entries})
        return build_table(channels, columns).position.tolist()

    swapped = [{"name": "x", "column": "knee"}, {"name": "y", "column": "hip"}]
    assert position("a.npz", swapped) == q[:, ::-1].tolist()
    assert position("b.npz", ["x", "y"]) == q.tolist()
    by_index = [{"name": "x", "column": "typo", "index": 1}, {"name": "y", "index": 0}]
    assert position("a.npz", by_index) == q[:, ::-1].tolist()
    for file, joints, entries, words in (
        ("a.npz", ["x", "y"], {}, "asks for 'x' in 'q', which has none of that name; its columns: hip, knee"),
        ("a.npz", [{"name": "x", "column": "typo"}, "knee"], {}, "asks for 'typo' in 'q'"),
        ("a.npz", ["hip", "knee"], {"target": "u"}, "'u' has 1 columns, and the file names 2"),
        ("b.npz", swapped, {}, "'knee' for joint 'x', but the 2 columns of 'q' have no names; give `index`"),
        ("c.npz", ["hip", "knee"], {}, "several of that name"),
    ):
        with pytest.raises(DatasetError, match=words):
            position(file, joints, **entries)


def test_unknown_files(tmp_path: Path) -> None:
    """A file of no known kind, a missing one, and a folder without a dataset are refused."""
    for path, words in (
        (write(tmp_path / "a.ulg", "x"), "'.ulg' are not known"),
        (tmp_path / "none.csv", "does not exist"),
        (tmp_path, "a LeRobot dataset"),
    ):
        with pytest.raises(DatasetError, match=words):
            read_channels(path)
    with pytest.raises(DatasetError, match=r"cannot tell which channel is the time.*\(in Python: columns=\)"):
        load_tables(write(tmp_path / "a.csv", "a,b\n1,2\n"))
    with pytest.raises(DatasetError, match="cannot tell which channels are the joints' positions"):
        load_tables(write(tmp_path / "b.csv", "time,b\n1,2\n"))
    assert json.dumps(load_tables(write(tmp_path / "c.csv", "time,a_pos\n0,2\n1,3\n"))[0].source)


def test_a_map_without_a_time_takes_the_channel_of_that_name(tmp_path: Path) -> None:
    """LeRobot's timestamp, a file's time_ms; without one the message asks for it."""
    columns = parse_column_map({"joints": [{"name": "a", "position": "q"}]})
    (table,) = load_tables(write(tmp_path / "a.csv", "time_ms,q\n0,1\n20,2\n"), columns)
    assert table.time_s.tolist() == [0.0, 0.02]
    with pytest.raises(DatasetError, match="cannot tell which channel is the time"):
        load_tables(write(tmp_path / "b.csv", "zeit,q\n0,1\n20,2\n"), columns)


def test_doubled_columns_and_other_kinds_of_file_are_named(tmp_path: Path) -> None:
    """Which column is doubled; that a file called .mcap is none; that one ends in the middle."""
    with pytest.raises(DatasetError, match="there more than once: 'b', 'c'"):
        load_tables(write(tmp_path / "a.csv", "time,b,c,b,c\n0,1,2,3,4\n"))
    with pytest.raises(DatasetError, match=r"begins with b'no mcap', MCAP with .*another kind of file"):
        read_mcap(write(tmp_path / "x.mcap", "no mcap"))
    whole = joint_states(tmp_path / "bag.mcap", [("left", "right")] * 9).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[:60])
    with pytest.raises(DatasetError, match=r"cut.mcap cannot be read as MCAP") as refused:
        read_mcap(tmp_path / "cut.mcap")
    assert "unpack requires" not in str(refused.value)
    (tmp_path / "magic.mcap").write_bytes(whole[:12])
    with pytest.raises(DatasetError, match="in the middle of a record"):
        read_mcap(tmp_path / "magic.mcap")
