"""Reads a LeRobot dataset folder (v2.x or v3.0); the videos stay untouched.

Facts of the format, from the documentation of LeRobotDataset v3.0 and from the `meta/info.json` of published
datasets: ``meta/info.json`` holds ``codebase_version``, ``fps`` and ``features`` (dtype, shape, names);
``data/chunk-*/*.parquet`` hold one row a frame, one episode a file in v2 and several in v3, with
``episode_index``, ``frame_index`` and ``timestamp`` [s since the episode's start, float32] beside the
features. The action of a frame is sent right after the frame was observed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats
from deal_hw.errors import DatasetError, MissingExtraError
from deal_hw.types import FloatArray

FLOAT32_STAMP_S = 1e-4
"""Stamps nearer than this to frame_index / fps are the float32 rounding of it."""
_DROPPED = ("index", "task_index", "episode_index", "frame_index")


def is_lerobot(path: Path) -> bool:
    """Say whether a folder looks like a LeRobot dataset."""
    return (Path(path) / "meta" / "info.json").is_file()


def read_lerobot(path: Path, episodes: tuple[int, ...] | None = None) -> list[Channels]:
    """Read a LeRobot dataset; one :class:`Channels` an episode, in the order of their numbers.

    Args:
        path: The dataset's folder.
        episodes: Which to read; None: all.

    Raises:
        MissingExtraError: pyarrow is not installed.
        DatasetError: It is not a LeRobot dataset, or lacks an episode that was asked for.
    """
    path = Path(path)
    info = _info(path)
    files = sorted((path / "data").glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"{path} has no data/*/*.parquet; is the dataset downloaded whole?")
    found: dict[int, list[dict[str, FloatArray]]] = {}
    for file in files:
        for number, arrays in _read_file(file, info["features"]):
            if episodes is None or number in episodes:
                found.setdefault(number, []).append(arrays)
    missing = sorted(set(episodes or ()) - set(found))
    if missing:
        raise DatasetError(f"{path} has no episodes {missing}; it has {len(found)} that were asked for")
    digest = _digest(path, files)
    labels = {name: _names(feature) for name, feature in info["features"].items()}
    return [
        Channels(
            path=path,
            kind="lerobot",
            digest=digest,
            arrays=_stamped(_joined(parts), float(info["fps"])),
            labels={name: names for name, names in labels.items() if names},
            part=f"episode {number}",
        )
        for number, parts in sorted(found.items())
    ]


def _info(path: Path) -> dict[str, Any]:
    try:
        info: dict[str, Any] = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
        if not isinstance(info["features"], dict) or not float(info["fps"]) > 0:
            raise ValueError(f"fps {info['fps']!r}")
    except OSError as error:
        raise DatasetError(f"{path} is not a LeRobot dataset: it has no meta/info.json") from error
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(
            f"{path / 'meta/info.json'} is not that of a LeRobot dataset: {error!r}"
        ) from error
    return info


def _read_file(file: Path, features: Mapping[str, Any]) -> list[tuple[int, dict[str, FloatArray]]]:
    """Return number and channels of each episode in a Parquet file."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("pyarrow", "lerobot") from error
    try:
        known = pq.read_schema(file).names
        wanted = [
            name
            for name, feature in features.items()
            if name in known and str(feature.get("dtype", "")).startswith(("float", "int", "bool"))
        ]
        wanted += [name for name in ("episode_index", "frame_index") if name in known and name not in wanted]
        table = pq.read_table(file, columns=wanted)
        arrays = {name: _array(table.column(name)) for name in wanted}
        number = arrays["episode_index"].astype(np.int64)
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        raise DatasetError(f"{file} cannot be read as data of a LeRobot dataset: {error}") from error
    return [
        (int(n), {name: values[number == n] for name, values in arrays.items()}) for n in np.unique(number)
    ]


def _array(column: Any) -> FloatArray:
    """Return a Parquet column, (T,) for numbers, (T, K) for lists of equal length."""
    import pyarrow as pa

    whole = column.combine_chunks()
    if isinstance(whole, pa.ChunkedArray):
        whole = pa.concat_arrays(whole.chunks) if whole.num_chunks else pa.array([], whole.type.value_type)
    if pa.types.is_list(whole.type) or pa.types.is_fixed_size_list(whole.type):
        flat = as_floats(whole.flatten().to_numpy(zero_copy_only=False))
        return flat.reshape(len(whole), -1) if len(whole) else np.empty((0, 1))
    return as_floats(whole.to_numpy(zero_copy_only=False))


def _joined(parts: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _stamped(arrays: dict[str, FloatArray], fps: float) -> dict[str, FloatArray]:
    """Return the channels with ``timestamp`` in full precision where it is frame_index / fps in float32."""
    frame = arrays.get("frame_index")
    if frame is not None:
        regular = frame / fps
        given = arrays.get("timestamp", regular)
        if np.all(np.abs(given - regular) < FLOAT32_STAMP_S):
            arrays["timestamp"] = regular
    if "command_age" in arrays:  # Written by our own export: when each action came into force.
        sent = np.round(arrays["timestamp"] - arrays["command_age"], 6)
        arrays["command_time"] = np.maximum.accumulate(sent)
    return {name: values for name, values in arrays.items() if name not in _DROPPED}


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's columns; older datasets nest them, as in {motors: [...]}."""
    names = feature.get("names")
    if isinstance(names, dict):
        lists = [value for value in names.values() if isinstance(value, list)]
        names = lists[0] if len(lists) == 1 else list(names)
    return tuple(str(name) for name in names) if isinstance(names, list) else ()


def _digest(path: Path, files: list[Path]) -> str:
    """Return a digest of the data files; a dataset may be large, so each counts by its own digest."""
    whole = hashlib.sha256((path / "meta" / "info.json").read_bytes())
    for file in files:
        with open(file, "rb") as opened:
            whole.update(hashlib.file_digest(opened, "sha256").digest())
    return whole.hexdigest()
