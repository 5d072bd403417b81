"""Recordings in Parquet, JSON, HDF5, MAT and bags of ROS 1, all of one motion."""

from __future__ import annotations

import json
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.importing.load import load_tables, read_channels
from deal_hw.errors import DatasetError, MissingExtraError
from deal_hw.install import install_line

TIME = np.arange(50) / 100
POSITION = np.stack([np.sin(3 * TIME), np.cos(2 * TIME)], axis=1)
TARGET = np.round(POSITION + 0.1, 3)
COLUMNS = {
    "time": TIME,
    "a_pos": POSITION[:, 0],
    "b_pos": POSITION[:, 1],
    "a_cmd": TARGET[:, 0],
    "b_cmd": TARGET[:, 1],
}
LISTS = {name: values.tolist() for name, values in COLUMNS.items()}
RECORDS = [dict(zip(LISTS, row, strict=True)) for row in zip(*LISTS.values(), strict=True)]
NAMES = ["a", "b"]
JOINTS = ("a_joint", "b_joint")


def check(path: Path, count: int = 1) -> str:
    """Check that a file holds the motion, so many times, and return what was said."""
    said: list[str] = []
    tables = load_tables(path, joints=JOINTS, say=said.append)
    assert len(tables) == count
    for table in tables:
        np.testing.assert_allclose(table.time_s, TIME, atol=1e-9)
        np.testing.assert_allclose(table.position, POSITION, atol=1e-15)
        np.testing.assert_allclose(table.target, TARGET, atol=1e-15)
    return "\n".join(said)


def nested(row: dict[str, float]) -> dict[str, Any]:
    """Return a record with an object for each joint."""
    joints = {name: {"pos": row[f"{name}_pos"], "cmd": row[f"{name}_cmd"]} for name in NAMES}
    return {"header": {"stamp": row["time"]}, **joints}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(LISTS),
        json.dumps(RECORDS),
        "\n".join(map(json.dumps, RECORDS)),
        json.dumps([nested(row) for row in RECORDS]),
        json.dumps({name: {str(k): x for k, x in enumerate(cells)} for name, cells in LISTS.items()}),
        json.dumps({"columns": list(LISTS), "index": [], "data": [list(row.values()) for row in RECORDS]}),
        json.dumps(
            {
                "log": {
                    "time": LISTS["time"],
                    "joints": NAMES,
                    "q": POSITION.tolist(),
                    "q_des": TARGET.tolist(),
                }
            }
        ),
        json.dumps(
            [{**row, "time": f"2026-11-30T12:00:{row['time']:09.6f}Z", "note": "x"} for row in RECORDS]
        ),
    ],
)
def test_json(tmp_path: Path, text: str) -> None:
    """Columns, records, records by lines, nested objects, arrays, and what pandas writes."""
    path = tmp_path / "r.json"
    path.write_text(text, encoding="utf-8")
    check(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("3", "holds no table: it is no object"),
        (
            '{"shoulder_pan": {"id": 1, "homing_offset": -3}}',
            "holds no table: it is an object with shoulder_pan",
        ),
        (
            '{"time": [0, 1], "a_pos": [[1], [1, 2]]}',
            "a_pos is left out: its cells are no numbers, or lists of",
        ),
        ('{"time": [0, 1', "cannot be read as JSON"),
        ("[" * 100_000, "nested too deep"),
    ],
)
def test_json_that_is_no_table(tmp_path: Path, text: str, words: str) -> None:
    """What it holds is named."""
    path = tmp_path / "r.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError, match=words):
        load_tables(path)


VALUES = st.recursive(
    st.none() | st.floats() | st.text(max_size=3) | st.booleans(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["time", "0", "a"]), inner),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None)
@given(values=VALUES)
def test_any_json_is_a_table_or_refused(values: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    """No parser's exception reaches the user."""
    path = tmp_path_factory.mktemp("json") / "r.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    try:
        read_channels(path)
    except DatasetError as error:
        assert str(path) in str(error)


def test_parquet(tmp_path: Path) -> None:
    """Columns of numbers, of lists and of dates; two columns of dates have one zero."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "r.parquet"
    pq.write_table(pa.table(COLUMNS), path)
    check(path)
    stamps = pa.array(1_764_504_000_123_456_789 + np.round(TIME * 1e9).astype(np.int64))
    table = {
        "timestamp": stamps.cast(pa.timestamp("ns", "UTC")),
        "command_time": stamps.cast(pa.timestamp("ns")),
        "joint_pos": pa.array(list(POSITION)),
        "joint_cmd": pa.array(list(TARGET), pa.list_(pa.float64(), 2)),
        "note": ["x"] * len(TIME),
    }
    pq.write_table(pa.table(table), path)
    assert "note is left out: string" in check(path)
    (found,) = load_tables(path, joints=JOINTS)
    np.testing.assert_allclose(found.command_s, TIME, atol=1e-9)


def test_hdf5(tmp_path: Path) -> None:
    """Datasets, groups, units, joints' names and pictures; groups alike are recordings of their own."""
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file.update(COLUMNS)
        file["time"][...] *= 1000
        file["time"].attrs["units"] = "ms"
    check(path)
    with h5py.File(path, "w") as file:
        group = file.create_group("data")
        group.update({"time": TIME[:, None], "qpos": POSITION, "action": TARGET, "joint_names": NAMES})
        group["picture"] = np.zeros((5, 2, 2, 3), np.uint8)
        group["elsewhere"] = h5py.ExternalLink("other.h5", "/x")
    assert "data.picture is left out: uint8 (5, 2, 2, 3)" in check(path)
    with h5py.File(path, "w") as file:
        for number in range(3):
            group = file.create_group(f"data/demo_{number}")
            group.update({"obs/time": TIME + number, "obs/joint_pos": POSITION, "actions": TARGET})
    check(path, 3)
    assert [channels.part for channels in read_channels(path)] == ["demo_0", "demo_1", "demo_2"]
    with h5py.File(path, "w") as file:
        file.create_group("data")
    with pytest.raises(DatasetError, match="holds no arrays; its groups: data"):
        load_tables(path)


def matlab73(path: Path) -> Path:
    """Write a MAT file of version 7.3: HDF5 behind a header, with columns as rows, and texts by reference."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("time", TIME[:, None]), ("q", POSITION), ("q_des", TARGET)):
            file.create_dataset(name, data=values.T).attrs["MATLAB_class"] = np.bytes_("double")
        letters = file.create_group("#refs#")
        cells = [letters.create_dataset(n, data=np.array([[ord(n)]], np.uint16)).ref for n in NAMES]
        names = file.create_dataset("names", data=np.array([cells], dtype=h5py.ref_dtype))
        names.attrs["MATLAB_class"] = np.bytes_("cell")
    data = bytearray(path.read_bytes())
    data[:22] = b"MATLAB 7.3 MAT-file, P"
    path.write_bytes(data)
    return path


def test_mat(tmp_path: Path) -> None:
    """Rows and columns, structures, cells and matrices of letters, packed or not, and version 7.3."""
    scipy_io = pytest.importorskip("scipy.io")
    path = tmp_path / "r.mat"
    cell = np.array(NAMES, dtype=object)
    written: list[tuple[dict[str, Any], bool]] = [
        ({"time": TIME, "dof_pos": POSITION, "des_dof_pos": TARGET, "joint_names": cell}, False),
        ({name: values[:, None] for name, values in COLUMNS.items()}, True),
        ({"log": {"time": TIME, "q": POSITION, "q_des": TARGET, "names": np.array(NAMES)}}, True),
    ]
    for values, packed in written:
        scipy_io.savemat(path, values, do_compression=packed)
        check(path)
    scipy_io.savemat(path, {"time": TIME, "q": POSITION.T, "q_des": TARGET.T})
    with pytest.raises(DatasetError, match=r"'q' has shape \(2, 50\), but there are 50 times.*transpose"):
        load_tables(path, joints=JOINTS)
    check(matlab73(path))


def test_a_mat_file_does_not_unpack_to_gigabytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A variable of zeros is a thousandth of its size; it is counted before it is read."""
    scipy_io = pytest.importorskip("scipy.io")
    from deal_hw.data.importing import mat_source

    path = tmp_path / "r.mat"
    scipy_io.savemat(path, {"time": np.zeros(100_000)}, do_compression=True)
    monkeypatch.setattr(mat_source, "NUMBERS", 50_000)
    with pytest.raises(DatasetError, match="more than 50000 numbers"):
        load_tables(path)


def test_bag_of_ros_1(tmp_path: Path) -> None:
    """Joint states with names and stamps, commands in order, and a topic with a list of messages."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    types = store.types
    path = tmp_path / "r.bag"
    with rosbag1.Writer(path) as bag:
        state = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        command = bag.add_connection("/arm/command", "std_msgs/msg/Float64MultiArray", typestore=store)
        others = bag.add_connection("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", typestore=store)
        layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        for number, seconds in enumerate(TIME):
            ns = 1_764_504_000_000_000_000 + round(seconds * 1e9)
            stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            header = types["std_msgs/msg/Header"](seq=number, stamp=stamp, frame_id="")
            values = {
                "position": POSITION[number, ::-1].copy(),
                "velocity": np.zeros(0),
                "effort": np.zeros(0),
            }
            message = types["sensor_msgs/msg/JointState"](header=header, name=NAMES[::-1], **values)
            bag.write(state, ns, store.serialize_ros1(message, "sensor_msgs/msg/JointState"))
            message = types["std_msgs/msg/Float64MultiArray"](layout=layout, data=TARGET[number, ::-1].copy())
            bag.write(command, ns, store.serialize_ros1(message, "std_msgs/msg/Float64MultiArray"))
            message = types["diagnostic_msgs/msg/DiagnosticArray"](header=header, status=[])
            bag.write(others, ns, store.serialize_ros1(message, "diagnostic_msgs/msg/DiagnosticArray"))
    assert "DiagnosticStatus[] is a list of messages" in check(path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DatasetError, match="cannot be read as a bag of ROS 1"):
        load_tables(path)


@pytest.mark.parametrize(
    ("name", "package"),
    [("r.parquet", "pyarrow"), ("r.h5", "h5py"), ("r.mat", "scipy"), ("r.bag", "rosbags")],
)
def test_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    """Without the library, the error has the line that installs it."""
    (tmp_path / name).write_bytes(b"MATLAB 5.0 MAT-file")
    for known in [found for found in sys.modules if found.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, known)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError) as caught:
        read_channels(tmp_path / name)
    assert str(caught.value).endswith(install_line("formats")) and package in str(caught.value)


@pytest.mark.parametrize("end", [".parquet", ".h5", ".mat", ".bag"])
def test_damaged_files_are_one_line(tmp_path: Path, end: str) -> None:
    """Bytes of another kind are refused with the kind that was expected."""
    for package in ("pyarrow", "h5py", "scipy", "rosbags"):
        pytest.importorskip(package)
    path = tmp_path / f"r{end}"
    for data in (b"", b"x" * 200, zlib.compress(b"0" * 1000), np.random.default_rng(0).bytes(3000)):
        path.write_bytes(data)
        with pytest.raises(DatasetError, match="cannot be read as") as caught:
            read_channels(path)
        assert "\n" not in str(caught.value)
