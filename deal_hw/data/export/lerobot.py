"""Writes recordings as a LeRobot dataset, layout v3.0, without videos.

Facts of the format, from the documentation of LeRobotDataset v3.0 and from the `meta/info.json` of published
datasets: ``meta/info.json`` (version, fps, features, path templates), ``meta/tasks.parquet`` (text ->
task_index, the text as a pandas index), ``meta/episodes/chunk-000/file-000.parquet`` (one row an episode:
length, range of frames, file, statistics), ``meta/stats.json``, and ``data/chunk-000/file-000.parquet`` with
one row a frame and one row group an episode. Frames lie on a uniform grid of ``fps``: ``timestamp`` is
frame_index / fps.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from deal_hw.data.files import write_json
from deal_hw.data.importing.grid import common_period, to_trajectories
from deal_hw.data.table import table_of
from deal_hw.errors import DatasetError, InsufficientDataError, MissingExtraError
from deal_hw.types import FloatArray, Trajectory

VERSION = "v3.0"
CHUNK_FILES = 1000
FILE_MIB = 100
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


_Frames = dict[str, npt.NDArray[Any]]
"""Values of one episode's F frames, by feature, (F,) or (F, K)."""


def export_lerobot(
    trajectories: Sequence[Trajectory],
    folder: Path,
    robot_type: str = "",
    task: str = "deal-hw",
    most_filled: float = 0.5,
    names: Sequence[str] = (),
) -> tuple[int, int]:
    """Write a LeRobot dataset, one episode per recording; return its numbers of frames and of filled ones.

    ``observation.state`` holds measured positions, ``action`` the active position target at the frame, each
    named ``<joint>.pos`` in rad or m; ``observation.velocity`` and ``observation.effort`` follow where they
    were measured. Each of these features has its ``units`` in ``info.json``. ``command_age`` is the time from
    the start of the action to the frame [s], which keeps the exact timing.

    Frames lie on a uniform grid without holes. A frame with a lost sample is interpolated from its
    neighbours, with ``filled`` true; importing leaves it out again. There are no frames before the first
    command.

    Args:
        trajectories: Of one robot.
        folder: Folder to write, without a dataset in it.
        robot_type: Goes into ``info.json``.
        task: Description of the robot's task.
        most_filled: A recording with a larger share of filled frames is refused.
        names: Names of the recordings in messages; by default recording 0, recording 1, ...

    Raises:
        MissingExtraError: pyarrow is not installed.
        DatasetError: The folder has a dataset already, the recordings do not fit one dataset, or too much of
            one was lost.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("pyarrow", "lerobot") from error
    folder = Path(folder)
    if (folder / "meta" / "info.json").exists():
        raise DatasetError(f"{folder} already contains a LeRobot dataset; name another folder")
    if not trajectories:
        raise InsufficientDataError("the dataset has no recording to export; record or import one")
    first = trajectories[0]
    if any((t.joint_names, t.actuated) != (first.joint_names, first.actuated) for t in trajectories):
        raise DatasetError("the recordings have different joints; export those of one robot at a time")
    if not first.actuated:
        raise DatasetError(
            "no joint of the robot has an actuator, and every frame of LeRobot's format has an action; use "
            "--format foxglove"
        )
    names = names or [f"recording {number}" for number in range(len(trajectories))]
    tables = [table_of(trajectory, name) for trajectory, name in zip(trajectories, names, strict=True)]
    period = common_period(tables)
    episodes = []
    for table in tables:
        (whole,) = to_trajectories(table, period_s=period, gap_periods=math.inf)
        episodes.append(_frames(table.name, whole.trajectory, period, most_filled))
    features = _features(first, tables[0].units, episodes)
    episodes = [{name: frames[name] for name in features} for frames in episodes]
    try:
        _write(folder, episodes, features, 1 / period, robot_type, task)
    except OSError as error:
        raise DatasetError(f"{folder} cannot be written: {error.strerror}") from error
    filled = np.concatenate([frames["filled"] for frames in episodes])
    return filled.size, int(filled.sum())


def _frames(name: str, trajectory: Trajectory, period: float, most_filled: float) -> _Frames:
    """Return the frames from the first command on, lost ones filled and flagged."""
    begin = int(np.argmax(trajectory.command_sequence >= 0))
    time_s = trajectory.device_s[begin:] - trajectory.device_s[begin]
    if time_s.size < 2 or trajectory.command_sequence[begin] < 0:
        raise InsufficientDataError(f"{name} has fewer than two samples with an active command; leave it out")
    index = np.round(time_s / period).astype(np.int64)
    length = int(index[-1]) + 1
    if length - index.size > most_filled * length:
        raise DatasetError(
            f"{name} lacks {length - index.size} of {length} samples; LeRobot's grid is uniform, and at "
            f"most {most_filled:.0%} of it may be filled: leave this recording out"
        )
    filled = np.ones(length, dtype=bool)
    filled[index] = False
    grid = np.arange(length)

    def on_grid(values: FloatArray) -> FloatArray:
        return np.stack([np.interp(grid, index, column) for column in values[begin:].T], axis=1)

    # A command is active until the next one, even if no sample shows it.
    sent_s = trajectory.sent_s - trajectory.device_s[begin]
    in_force = np.searchsorted(sent_s, grid * period + 1e-9, side="right") - 1
    return {
        "observation.state": on_grid(trajectory.position),
        "observation.velocity": on_grid(trajectory.velocity),
        "observation.effort": on_grid(trajectory.effort),
        "action": trajectory.position_target[in_force],
        "command_age": np.maximum(grid * period - sent_s[in_force], 0.0),
        "filled": filled,
    }


def _features(
    first: Trajectory, units: Sequence[str], episodes: Sequence[_Frames]
) -> dict[str, dict[str, Any]]:
    """Return the features that every frame has, as ``info.json`` lists them."""
    unit = dict(zip(first.joint_names, units, strict=True))
    features: dict[str, dict[str, Any]] = {}
    for name, word, joints in (
        ("observation.state", "pos", first.joint_names),
        ("observation.velocity", "vel", first.joint_names),
        ("observation.effort", "effort", first.joint_names),
        ("action", "pos", first.actuated),
    ):
        if all(np.isfinite(frames[name]).all() for frames in episodes):
            features[name] = {
                "dtype": "float32",
                "shape": [len(joints)],
                "names": [f"{joint}.{word}" for joint in joints],
                "units": [_UNITS[word].get(unit[joint], unit[joint]) for joint in joints],
            }
    age = {"dtype": "float32", "shape": [1], "names": None, "units": ["s"]}
    return {**features, "command_age": age, "filled": {"dtype": "bool", "shape": [1], "names": None}}


_UNITS: Mapping[str, Mapping[str, str]] = {
    "pos": {},
    "vel": {"rad": "rad/s", "m": "m/s"},
    "effort": {"rad": "N*m", "m": "N"},
}
"""Unit of each quantity of a joint, by the unit of its position."""

_INDEX_FEATURES = {
    name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index")
}


def _write(
    folder: Path,
    episodes: Sequence[_Frames],
    features: Mapping[str, dict[str, Any]],
    fps: float,
    robot_type: str,
    task: str,
) -> None:
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    writer, written, file, begin = None, 0, 0, 0
    for number, episode in enumerate(episodes):
        length = len(episode["filled"])
        frames = {**episode, **_indices(number, length, begin, fps)}
        table = _arrow({**features, **_INDEX_FEATURES}, frames)
        if writer is not None and written + table.nbytes > FILE_MIB * 2**20:
            writer.close()
            writer, written, file = None, 0, file + 1
        place = {"chunk_index": file // CHUNK_FILES, "file_index": file % CHUNK_FILES}
        if writer is None:
            path = folder / DATA_PATH.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, table.schema, compression="snappy")
        writer.write_table(table)
        written += table.nbytes
        rows.append(_episode_row(number, length, begin, place, task, frames))
        begin += length
    if writer is not None:
        writer.close()
    _write_episodes(folder, rows)
    _write_tasks(folder, task)
    whole = {name: np.concatenate([episode[name] for episode in episodes]) for name in features}
    write_json(folder / "meta" / "stats.json", {name: _statistics(values) for name, values in whole.items()})
    # Last of all, since a folder with info.json counts as a complete dataset.
    write_json(folder / "meta" / "info.json", _info(features, fps, len(episodes), begin, robot_type))


def _info(
    features: Mapping[str, dict[str, Any]], fps: float, episodes: int, frames: int, robot_type: str
) -> dict[str, Any]:
    whole = round(fps)
    return {
        "codebase_version": VERSION,
        "robot_type": robot_type or None,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MIB,
        "video_files_size_in_mb": 200,
        # An integer if it is whole, as readers expect. A rate like 49.85 Hz must not be rounded.
        "fps": whole if abs(fps - whole) < 1e-6 * fps else fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": {**features, **_INDEX_FEATURES},
    }


def _indices(number: int, length: int, begin: int, fps: float) -> dict[str, Any]:
    frame = np.arange(length)
    return {
        "timestamp": frame / fps,
        "frame_index": frame,
        "episode_index": np.full(length, number),
        "index": begin + frame,
        "task_index": np.zeros(length, dtype=np.int64),
    }


def _arrow(features: Mapping[str, dict[str, Any]], frames: Mapping[str, Any]) -> Any:
    import pyarrow as pa

    columns = {}
    for name, feature in features.items():
        values = np.ascontiguousarray(frames[name], dtype=feature["dtype"])
        flat = pa.array(values.reshape(-1))
        # LeRobot reads shape [1] as a plain number, named or not, and fails on a list of one.
        (width,) = feature["shape"]
        columns[name] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.table(columns)


def _episode_row(
    number: int, length: int, begin: int, place: Mapping[str, int], task: str, frames: Mapping[str, Any]
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "episode_index": number,
        "tasks": [task],
        "length": length,
        "data/chunk_index": place["chunk_index"],
        "data/file_index": place["file_index"],
        "dataset_from_index": begin,
        "dataset_to_index": begin + length,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for name, values in frames.items():
        row |= {f"stats/{name}/{key}": value for key, value in _statistics(np.asarray(values)).items()}
    return row


def _statistics(values: FloatArray) -> dict[str, list[float] | list[int]]:
    table = values.reshape(len(values), -1).astype(np.float64)
    return {
        "min": table.min(axis=0).tolist(),
        "max": table.max(axis=0).tolist(),
        "mean": table.mean(axis=0).tolist(),
        "std": table.std(axis=0).tolist(),
        "count": [len(table)],
    }


def _write_episodes(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / EPISODES_PATH.format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({key: [row[key] for row in rows] for key in rows[0]}), path)


def _write_tasks(folder: Path, task: str) -> None:
    """Write the task; the pandas metadata make its text the index, in which LeRobot searches."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        types = {"pandas_type": pandas_type, "numpy_type": numpy_type, "metadata": None}
        return {"name": name, "field_name": name, **types}

    note = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([task])})
    pq.write_table(
        table.replace_schema_metadata({"pandas": json.dumps(note)}), folder / "meta" / "tasks.parquet"
    )
