"""LeRobot datasets, out and in again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.export.lerobot import export_lerobot
from deal_hw.data.importing import lerobot_source
from deal_hw.data.importing.columns import parse_column_map
from deal_hw.data.importing.grid import period_of, to_trajectories
from deal_hw.data.importing.lerobot_source import read_lerobot
from deal_hw.data.importing.load import load_tables
from deal_hw.data.table import Table
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.sim.mjcf.joint_facts import joint_facts
from deal_hw.types import Trajectory
from deal_hw.workflows.lerobot_columns import LeRobotColumns, columns_of_lerobot

MakeTable = Callable[..., Table]
MakeTrajectory = Callable[..., Trajectory]


def some_table(samples: int, joints: int, actuated: int, rate_hz: float, seed: int) -> Table:
    """Return a recording of random numbers that float32 holds exactly."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(samples) / rate_hz
    names = tuple(f"joint_{i}" for i in range(joints))
    return Table(
        joint_names=names,
        actuated=names[:actuated],
        units=("rad",) * joints,
        time_s=time_s,
        position=rng.integers(-999, 999, (samples, joints)) / 256.0,
        velocity=rng.integers(-999, 999, (samples, joints)) / 256.0,
        effort=None,
        command_s=time_s,
        target=rng.integers(-999, 999, (samples, actuated)) / 256.0,
        orientation=None,
        gyro=None,
        source={"file": "x", "part": ""},
    )


@settings(max_examples=25, deadline=None)
@given(
    lengths=st.lists(st.integers(3, 60), min_size=1, max_size=4),
    joints=st.integers(1, 7),
    data=st.data(),
    rate_hz=st.sampled_from([20.0, 30.0, 50.0, 49.84996391, 200.0]),
)
def test_round_trip(
    lengths: list[int],
    joints: int,
    data: st.DataObject,
    rate_hz: float,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Any number of episodes, lengths and joints comes back: values bit by bit, times to a microsecond."""
    actuated = data.draw(st.integers(1, joints))
    folder = tmp_path_factory.mktemp("lerobot") / "out"
    tables = [some_table(length, joints, actuated, rate_hz, seed) for seed, length in enumerate(lengths)]
    parts = [part.trajectory for table in tables for part in to_trajectories(table)]
    frames, filled = export_lerobot(parts, folder, "test", "move about")
    assert (frames, filled) == (sum(lengths), 0)
    back = load_tables(folder)
    assert [table.source["part"] for table in back] == [f"episode {i}" for i in range(len(lengths))]
    for before, after in zip(tables, back, strict=True):
        assert (after.joint_names, after.actuated) == (before.joint_names, before.actuated)
        np.testing.assert_array_equal(after.position, before.position)
        np.testing.assert_array_equal(after.target, before.target)
        np.testing.assert_array_equal(after.velocity, before.velocity)
        np.testing.assert_allclose(after.time_s, before.time_s, atol=1e-9)
        np.testing.assert_allclose(after.command_s, before.command_s, atol=1e-6)
        assert period_of(after) == pytest.approx(1 / rate_hz, rel=1e-9)


def test_layout(make_trajectory: MakeTrajectory, tmp_path: Path) -> None:
    """The files of layout v3.0 with what a reader looks for: versions, paths, ranges, statistics, tasks."""
    assert (
        export_lerobot([make_trajectory(), make_trajectory()], tmp_path / "out", "cartpole", "swing up")
    ) == (1598, 0)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 200 and isinstance(info["fps"], int)
    assert info["robot_type"] == "cartpole" and info["splits"] == {"train": "0:2"}
    # The first command comes into force after the first sample: that one has no action and is no frame.
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, 1598, 1)
    state = info["features"]["observation.state"]
    assert state == {
        "dtype": "float32",
        "shape": [2],
        "names": ["cart.pos", "pole.pos"],
        "units": ["m", "rad"],
    }
    assert info["features"]["observation.effort"]["units"] == ["N", "N*m"]
    assert info["features"]["action"]["names"] == ["cart.pos"]
    assert {"timestamp", "frame_index", "episode_index", "index", "task_index"} < set(info["features"])
    table = pq.read_table(tmp_path / "out" / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"])
    assert table.schema.field("observation.state").type == pa.list_(pa.float32(), 2)
    # LeRobot reads shape [1] as a plain number and cannot cast a list of one.
    assert table.schema.field("action").type == pa.float32() and info["features"]["action"]["shape"] == [1]
    assert table.column("index").to_pylist() == list(range(1598))
    np.testing.assert_allclose(table.column("timestamp").to_pylist()[799:802], [0, 0.005, 0.01], atol=1e-7)
    file = pq.ParquetFile(tmp_path / "out" / "data/chunk-000/file-000.parquet")
    assert file.num_row_groups == 2
    episodes = pq.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes] == [
        (0, 799, 799),
        (799, 1598, 799),
    ]
    assert episodes[1]["tasks"] == ["swing up"] and episodes[1]["data/file_index"] == 0
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    position = make_trajectory().position[1:].astype(np.float32)
    np.testing.assert_allclose(stats["observation.state"]["max"], position.max(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["observation.state"]["std"], position.std(axis=0), rtol=1e-4)
    np.testing.assert_allclose(episodes[0]["stats/action/mean"], stats["action"]["mean"], atol=1e-9)
    tasks = pq.read_table(tmp_path / "out/meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "swing up"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_timing_of_slower_commands_survives(make_trajectory: MakeTrajectory, tmp_path: Path) -> None:
    """50 Hz commands, received 1 ms after a sample, come back at that time and not at the next frame."""
    export_lerobot([make_trajectory()], tmp_path / "out")
    (table,) = load_tables(tmp_path / "out")
    sent = np.unique(np.round(table.command_s + 0.005, 6))
    np.testing.assert_allclose(sent, 0.001 + 0.02 * np.arange(200), atol=2e-6)


def without(trajectory: Trajectory, lost: slice) -> dict[str, Any]:
    """Return the samples of a trajectory, as fields, without some."""
    keep = np.delete(np.arange(trajectory.device_s.size), lost)
    names = ("receive_s", "device_s", "position", "velocity", "effort", "status")
    return {name: getattr(trajectory, name)[keep] for name in (*names, "command_sequence", "command_age_s")}


@pytest.mark.parametrize(("lost", "filled"), [(slice(400, 401), 1), (slice(300, 340), 40)])
def test_lost_samples_are_filled_flagged_and_left_out_on_the_way_back(
    make_trajectory: MakeTrajectory, tmp_path: Path, lost: slice, filled: int
) -> None:
    """One episode a recording: a hole, also a long one, is interpolated and says so; importing takes none."""
    whole = make_trajectory()
    cut = make_trajectory(**without(whole, lost))
    assert export_lerobot([cut], tmp_path / "out") == (799, filled)
    table = pq.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    flags = np.array(table.column("filled").to_pylist())
    # The first sample has no command and is no frame.
    assert np.flatnonzero(flags).tolist() == list(range(lost.start - 1, lost.stop - 1))
    position = np.array(table.column("observation.state").to_pylist())
    middle = (lost.start + lost.stop - 1) / 2
    between = (whole.position[lost.start - 1] + whole.position[lost.stop]) / 2
    np.testing.assert_allclose(
        position[[int(middle - 1), int(np.ceil(middle - 1))]].mean(axis=0), between, atol=1e-6
    )
    (back,) = load_tables(tmp_path / "out")
    assert back.time_s.size == 799 - filled and back.units == ("m", "rad")
    np.testing.assert_allclose(np.diff(back.time_s).max(), 0.005 * (filled + 1), atol=1e-9)
    np.testing.assert_allclose(back.position, cut.position[1:], atol=1e-6)


def test_commands_during_lost_samples_survive(make_trajectory: MakeTrajectory, tmp_path: Path) -> None:
    """Samples 301 to 312 report commands 75 to 77: these were sent, although no sample shows them."""
    ramp = 1e-3 * np.arange(200)[:, None]
    whole = make_trajectory(position_target=ramp, requested_position=ramp)
    cut = make_trajectory(position_target=ramp, **without(whole, slice(301, 313)))
    export_lerobot([cut], tmp_path / "out")
    frames = pq.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    action = np.array(frames.column("action").to_pylist())
    # The first sample has no command and is no frame.
    np.testing.assert_allclose(action, ramp[whole.command_sequence[1:], 0], atol=1e-7)
    (back,) = load_tables(tmp_path / "out")
    assert back.time_s.size == 787
    np.testing.assert_allclose(np.unique(back.target), ramp[:, 0].astype(np.float32), atol=1e-9)


def test_a_recording_that_would_mostly_be_filled_is_refused(
    make_trajectory: MakeTrajectory, tmp_path: Path
) -> None:
    """A robot that was silent for most of the time gives no episode of invented frames."""
    cut = make_trajectory(**without(make_trajectory(), slice(100, 700)))
    with pytest.raises(DatasetError, match=r"recording 0 lacks 600 of 799 samples.*50%"):
        export_lerobot([cut], tmp_path / "out")


def test_jittered_recordings_with_a_pause(make_trajectory: MakeTrajectory, tmp_path: Path) -> None:
    """Samples off the grid are read at its times; in the pause nothing counts as measured."""
    rng = np.random.default_rng(0)
    whole = make_trajectory()
    fields = without(whole, slice(300, 340))
    fields["device_s"] = fields["device_s"] + rng.uniform(-0.001, 0.001, fields["device_s"].size)
    frames, filled = export_lerobot([make_trajectory(**fields)], tmp_path / "out")
    assert abs(frames - 799) <= 1 and abs(filled - 40) <= 1


def test_refusals(make_trajectory: MakeTrajectory, tmp_path: Path) -> None:
    """A folder that is taken, robots that differ, and folders that are no dataset are refused."""
    export_lerobot([make_trajectory()], tmp_path / "out")
    with pytest.raises(DatasetError, match="already"):
        export_lerobot([make_trajectory()], tmp_path / "out")
    other = make_trajectory(joint_names=("slider", "pole"))
    with pytest.raises(DatasetError, match="different joints"):
        export_lerobot([make_trajectory(), other], tmp_path / "two")
    with pytest.raises(DatasetError, match="no episodes \\[7\\]"):
        read_lerobot(tmp_path / "out", episodes=(7,))
    with pytest.raises(DatasetError, match=r"no meta/info\.json"):
        read_lerobot(tmp_path / "none")
    (tmp_path / "out/data/chunk-000/file-000.parquet").write_bytes(b"torn")
    with pytest.raises(DatasetError, match="cannot be read as data"):
        read_lerobot(tmp_path / "out")


def test_older_layout(tmp_path: Path) -> None:
    """v2.1: one file an episode, lists of any length type, names nested; extra columns stay away."""
    names = {"motors": ["pan", "lift"]}
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": names},
        "action": {"dtype": "float32", "shape": [2], "names": names},
        "observation.images.top": {"dtype": "video", "shape": [3, 4, 4], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    (tmp_path / "meta").mkdir()
    info = {"codebase_version": "v2.1", "fps": 30, "features": features}
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    folder = tmp_path / "data/chunk-000"
    folder.mkdir(parents=True)
    for episode in (0, 1):
        frame = np.arange(4)
        columns = {
            "observation.state": [[float(i), 10.0 * episode] for i in frame],
            "action": [[float(i) + 0.5, 1.0] for i in frame],
            "timestamp": pa.array((frame / 30).astype(np.float32)),
            "frame_index": frame,
            "episode_index": np.full(4, episode),
            "task_index": np.zeros(4, dtype=np.int64),
        }
        pq.write_table(pa.table(columns), folder / f"episode_{episode:06d}.parquet")
    first, second = load_tables(tmp_path, joints=("lift", "pan"))
    assert first.joint_names == ("lift", "pan")
    assert second.position.tolist() == [[10, 0], [10, 1], [10, 2], [10, 3]]
    assert second.target[:, 1].tolist() == [0.5, 1.5, 2.5, 3.5]
    np.testing.assert_allclose(second.time_s, np.arange(4) / 30, atol=1e-12)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (None, ()),
        (["pan", "lift"], ("pan", "lift")),
        ([["pan", "lift"]], ("pan", "lift")),
        ({"motors": ["pan", "lift"]}, ("pan", "lift")),
        ({"motors": [["pan", "lift"]]}, ("pan", "lift")),
        ({"left": ["pan", "lift"], "right": ["pan"]}, ("left.pan", "left.lift", "right.pan")),
        ({"lift": 1, "pan": 0}, ("pan", "lift")),
        (["pan", 7], ("pan", "7")),
    ],
)
def test_names_of_a_feature(names: Any, expected: tuple[str, ...]) -> None:
    """Every nesting that published datasets have ends as one name a column."""
    assert lerobot_source._names({"names": names}) == expected


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=30,
)


@given(JSON)
def test_names_of_any_json(names: Any) -> None:
    """Whatever stands there gives names, or is refused as nested too deep."""
    try:
        found = lerobot_source._names({"names": names})
    except ValueError as err:
        assert "nested" in str(err)
    else:
        assert all(isinstance(name, str) for name in found)


def test_arm_that_is_not_in_the_data(tmp_path: Path) -> None:
    """A map of the right arm on data of the left one is refused, with both lists; it was read by position."""
    names = [["left_pan.pos", "left_lift.pos"]]
    features = {
        name: {"dtype": "float32", "shape": [2], "names": names} for name in ("observation.state", "action")
    }
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text(json.dumps({"fps": 30, "features": features}))
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    rows = [[0.1 * i, 1.0] for i in range(4)]
    columns = {"observation.state": rows, "action": rows, "episode_index": [0] * 4, "frame_index": range(4)}
    pq.write_table(pa.table(columns), tmp_path / "data/chunk-000/file-000.parquet")

    def table(side: str) -> Table:
        joints = [{"name": name, "column": f"{side}_{name}"} for name in ("lift", "pan")]
        # A LeRobot dataset always has its time.
        entries = {"position": "observation.state", "target": "action"}
        (found,) = load_tables(tmp_path, parse_column_map({**entries, "joints": joints}))
        return found

    assert table("left").position[:, 0].tolist() == [1.0] * 4
    with pytest.raises(
        DatasetError, match=r"asks for 'right_lift' in 'observation.state'.*left_pan, left_lift"
    ):
        table("right")


@pytest.mark.parametrize(("limit", "refused"), [(100, True), (300, True), (100_000, False)])
def test_a_dataset_has_so_many_numbers_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int, refused: bool
) -> None:
    """Rows are counted before they are read, what their lists hold as they come."""
    folder = tmp_path / "set"
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    features = {
        name: {"dtype": "float32", "shape": [3], "names": None} for name in ("observation.state", "action")
    }
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 100, "features": features}))
    rows = [[0.0, 1.0, 2.0]] * 60
    table = pa.table(
        {"observation.state": rows, "action": rows, "episode_index": [0] * 60, "frame_index": range(60)}
    )
    pq.write_table(table, folder / "data" / "chunk-000" / "file-000.parquet")
    if refused:
        with pytest.raises(DatasetError, match=rf"file-000\.parquet .*more than {limit} numbers"):
            read_lerobot(folder, most_numbers=limit)
    else:
        assert read_lerobot(folder, most_numbers=limit)[0].arrays["action"].shape == (60, 3)


ARM = """<mujoco><compiler angle="radian"/><worldbody><body>
<joint name="pan" type="hinge" axis="0 0 1" range="-1.5 1.9"/>
<geom size=".1" mass="1"/><body pos="0 0 .2"><joint name="gripper" type="hinge" axis="0 1 0" range="0 2"/>
<geom size=".1" mass="1"/></body></body></worldbody><actuator><position joint="pan" kp="10"/>
<position joint="gripper" kp="10"/></actuator></mujoco>"""
TICK = 2 * np.pi / 4096


def servo_arm(folder: Path, state: np.ndarray, robot: str) -> Path:
    """Write a dataset of LeRobot, (T, 2), whose info names no unit, and return its folder."""
    feature = {"dtype": "float32", "shape": [2], "names": ["pan.pos", "gripper.pos"]}
    info = {"codebase_version": "v3.0", "fps": 100, "robot_type": robot}
    info["features"] = {"observation.state": feature, "action": feature}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "data/chunk-000").mkdir(parents=True)
    frame = np.arange(len(state))
    columns = {"observation.state": list(state), "action": list(state + 0.5), "frame_index": frame}
    table = pa.table({**columns, "episode_index": np.zeros(len(state), int)})
    pq.write_table(table, folder / "data/chunk-000/file-000.parquet")
    return folder


@pytest.mark.parametrize("robot", ["so101_follower", "so100", "koch", ""])
def test_servo_arms_without_a_unit_are_never_in_radians(tmp_path: Path, robot: str) -> None:
    """Small motions of a known arm, and values that no joint reaches in radians, are refused."""
    size = 1.0 if robot else 90.0
    state = size * np.stack([np.sin(np.arange(300) / 30), np.cos(np.arange(300) / 40) ** 2], axis=1)
    with pytest.raises(DatasetError, match=r"never radians: give the arm's calibration \(--lerobot"):
        load_tables(servo_arm(tmp_path / "d", state, robot), joints=("pan", "gripper"))


@pytest.mark.parametrize(
    ("travel", "most", "unit"),
    [(1600, 95.0, "share"), (3600, 150.0, "deg"), (3600, 90.0, None), (800, 150.0, "other")],
)
@pytest.mark.parametrize("drive_mode", [0, 1])
def test_calibration_gives_the_scale(
    tmp_path: Path, travel: int, most: float, unit: str | None, drive_mode: int
) -> None:
    """Values beyond 100 are degrees, beyond the travel in degrees shares of it; else the user must say."""
    pytest.importorskip("mujoco")
    state = np.stack([most * np.sin(np.arange(300) / 30), 50 + 40 * np.cos(np.arange(300) / 40)], axis=1)
    data = servo_arm(tmp_path / "d", state, "so101_follower")
    motor = {"drive_mode": drive_mode, "homing_offset": 0, "range_min": 2000 - travel // 2}
    motors = {"pan": {"id": 1, **motor, "range_max": 2000 + travel // 2}}
    motors["gripper"] = {"id": 2, **motor, "range_min": 1000, "range_max": 2200}
    (tmp_path / "arm.json").write_text(json.dumps(motors))
    (tmp_path / "arm.xml").write_text(ARM)
    calibration = LeRobotColumns(tmp_path / "arm.json", joint_facts(tmp_path / "arm.xml"))
    if unit is None or unit == "other":
        with pytest.raises(
            DatasetError, match="may be -100..100" if unit is None else "neither -100..100 nor"
        ):
            load_tables(data, calibration, ("pan", "gripper"))
        return
    (table,) = load_tables(data, calibration, ("pan", "gripper"))
    turn = (
        np.radians(state[:, 0]) * (-1) ** drive_mode
        if unit == "deg"
        else state[:, 0] / 100 * travel / 2 * TICK
    )
    # The middle of the travel is the middle of the model's range; a gripper of 100 is open by its travel.
    np.testing.assert_allclose(table.position[:, 0], 0.2 + turn, atol=1e-6)
    np.testing.assert_allclose(table.position[:, 1], 1.0 + (state[:, 1] / 100 - 0.5) * 1200 * TICK, atol=1e-6)


def test_calibration_of_another_arm_is_refused(tmp_path: Path) -> None:
    """The motors are named; a calibration without a model has no zero."""
    pytest.importorskip("mujoco")
    data = servo_arm(tmp_path / "d", np.full((30, 2), 120.0), "so101")
    motor = {"id": 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3000}
    (tmp_path / "arm.json").write_text(json.dumps({"elbow": motor}))
    (tmp_path / "arm.xml").write_text(ARM)
    calibration = LeRobotColumns(tmp_path / "arm.json", joint_facts(tmp_path / "arm.xml"))
    with pytest.raises(DatasetError, match="has no motor pan, gripper; its motors: elbow"):
        load_tables(data, calibration, ("pan", "gripper"))
    with pytest.raises(ConfigurationError, match="add --model or --robot"):
        columns_of_lerobot(tmp_path / "arm.json", None, mapped=False)
