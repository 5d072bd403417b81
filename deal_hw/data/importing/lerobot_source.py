"""Reads a LeRobot dataset folder (v2.x or v3.0), without its videos.

Facts of the format, from the documentation of LeRobotDataset v3.0 and from the `meta/info.json` of published
datasets: ``meta/info.json`` holds ``codebase_version``, ``fps`` and ``features`` (dtype, shape, names);
``data/chunk-*/*.parquet`` contain one row per frame, one episode per file in v2 and several in v3 , with
``episode_index``, ``frame_index`` and ``timestamp`` [s since the episode's start, float32] beside the
features. The action of a frame is sent right after the frame was observed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from deal_hw.data.files import sha256_of
from deal_hw.data.importing.channels import Channels
from deal_hw.data.importing.parquet_source import columns_of
from deal_hw.errors import DatasetError, short
from deal_hw.reading import NUMBERS, read_json, reading
from deal_hw.schema import OPEN, refusal
from deal_hw.types import FloatArray

FLOAT32_STAMP_S = 1e-4
"""Stamps closer than this to frame_index / fps are its float32 rounding [s]."""
_DEEPEST = 8
_JOINTS = ("observation.state", "action")
_SERVO_ARMS = re.compile(r"(bi_)?(so_?\d|so_|koch|lekiwi|omx|moss)")
"""Beginnings of the robot types whose servos LeRobot reads without radians."""
SERVO_UNIT = (
    "LeRobot's -100..100 of the travel, or degrees, never radians: give the arm's calibration "
    "(--lerobot FILE.json)"
)
"""Stands for the unit that LeRobot's datasets of servo arms do not name."""
MOST_RAD = 4 * np.pi
"""Joints of an arm do not turn farther; greater values are no radians [rad]."""
_DROPPED = ("index", "task_index", "episode_index", "frame_index")


def is_lerobot(path: Path) -> bool:
    """Return whether a folder looks like a LeRobot dataset."""
    return (Path(path) / "meta" / "info.json").is_file()


def read_lerobot(
    path: Path, episodes: tuple[int, ...] | None = None, most_numbers: int = NUMBERS
) -> list[Channels]:
    """Read a LeRobot dataset; one :class:`Channels` per episode, in the order of their numbers.

    Args:
        path: The dataset's folder.
        episodes: Which to read; None: all.
        most_numbers: Most numbers of one file.

    Raises:
        MissingExtraError: pyarrow is not installed.
        DatasetError: It is not a LeRobot dataset, or a requested episode is missing.
    """
    path = Path(path)
    info = _info(path)
    files = sorted((path / "data").glob("*/*.parquet"))
    if not files:
        raise DatasetError(f"{path} has no data/*/*.parquet; download the whole dataset")
    found: dict[int, list[dict[str, FloatArray]]] = {}
    for file in files:
        for episode, arrays in _read_file(file, info.features, most_numbers):
            for name, feature in info.features.items():
                # One motor's values are plain numbers in the file; a column name marks them as those of a
                # joint.
                if name in arrays and arrays[name].ndim == 1 and feature.get("names"):
                    arrays[name] = arrays[name][:, None]
            if episodes is None or episode in episodes:
                found.setdefault(episode, []).append(arrays)
    missing = sorted(set(episodes or ()) - set(found))
    if missing:
        raise DatasetError(f"{path} has no episodes {missing}; of the requested ones it has {len(found)}")
    digest = _digest(path, files)
    with reading(path / "meta" / "info.json", "the description of a LeRobot dataset"):
        labels = {name: _names(feature) for name, feature in info.features.items()}
        units = {
            name: tuple(map(short, _flat(f.get("units"), _DEEPEST))) for name, f in info.features.items()
        }
    joined = {episode: _joined(parts) for episode, parts in found.items()}
    if not any(units.values()) and _no_radians(info, joined.values()):
        units = {name: (SERVO_UNIT,) * len(names) for name, names in labels.items() if name in _JOINTS}
    return [
        Channels(
            path=path,
            kind="lerobot",
            digest=digest,
            arrays=_stamped(arrays, info.fps),
            labels={name: names for name, names in labels.items() if names},
            units={name: given for name, given in units.items() if given},
            part=f"episode {episode}",
        )
        for episode, arrays in sorted(joined.items())
    ]


def _no_radians(info: _Info, episodes: Iterable[dict[str, FloatArray]]) -> bool:
    """Return whether positions without a unit cannot be radians, by the kind of robot or by their size."""
    if _SERVO_ARMS.match((info.robot_type or "").lower()):
        return True
    states = [arrays[_JOINTS[0]] for arrays in episodes if _JOINTS[0] in arrays]
    return any(float(np.max(np.abs(state[np.isfinite(state)]), initial=0.0)) > MOST_RAD for state in states)


@dataclass(frozen=True, slots=True)
class _Info:
    """The used part of ``meta/info.json``: the features by name, the rate [Hz] and the kind of robot."""

    __pydantic_config__: ClassVar[Mapping[str, Any]] = OPEN

    features: dict[str, dict[str, Any]]
    fps: float
    robot_type: str | None = None

    def __post_init__(self) -> None:
        if not 1e-3 <= self.fps <= 1e6:
            raise refusal("fps", self.fps, "0.001 to 1e6 Hz")


def _info(path: Path) -> _Info:
    file = path / "meta" / "info.json"
    if not file.is_file():
        raise DatasetError(f"{path} is not a LeRobot dataset: it has no meta/info.json")
    return read_json(file, _Info, "the description of a LeRobot dataset")


def _read_file(file: Path, features: Mapping[str, Any], most: int) -> list[tuple[int, dict[str, FloatArray]]]:
    """Return number and channels of each episode in a Parquet file."""

    def wanted(schema: Any) -> list[str]:
        known = set(schema.names)
        names = [
            name
            for name, feature in features.items()
            if name in known and str(feature.get("dtype", "")).startswith(("float", "int", "bool"))
        ]
        return names + [name for name in ("episode_index", "frame_index") if name in known - set(names)]

    with reading(file, "data of a LeRobot dataset"):
        arrays, _ = columns_of(file, wanted, most, "lerobot")
        index = arrays["episode_index"]
        if index.ndim != 1 or not np.all((index >= 0) & (index < 2**31) & (index % 1 == 0)):
            raise ValueError("episode_index is not a column of whole numbers")
        episode = index.astype(np.int64)
        return [
            (int(n), {name: values[episode == n] for name, values in arrays.items()})
            for n in np.unique(episode)
        ]


def _joined(parts: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _stamped(arrays: dict[str, FloatArray], fps: float) -> dict[str, FloatArray]:
    """Return the channels, with ``timestamp`` in full precision if it is frame_index / fps in float32."""
    frame = arrays.get("frame_index")
    if frame is not None:
        regular = frame / fps
        given = arrays.get("timestamp", regular)
        if np.all(np.abs(given - regular) < FLOAT32_STAMP_S):
            arrays["timestamp"] = regular
    if "command_age" in arrays:  # Written by our own export: the start of each action.
        sent = np.round(arrays["timestamp"] - arrays["command_age"], 6)
        arrays["command_time_s"] = np.maximum.accumulate(sent)
    filled = arrays.pop("filled", np.zeros(1)) != 0
    if filled.any():  # Interpolated by our own export: no measurement, but the commands were sent.
        for name in (name for name in arrays if name.startswith("observation.")):
            arrays[name][filled] = np.nan
    return {name: values for name, values in arrays.items() if name not in _DROPPED}


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's columns, or ().

    Published datasets have a list, a list in a list, a mapping of one list ({motors: [...]}) or of several
    (left and right arm), or of names to indices.
    """
    return tuple(short(name) for name in _flat(feature.get("names"), _DEEPEST))


def _flat(names: Any, deepest: int) -> list[str]:
    if deepest == 0:
        raise ValueError(f"names of a feature are nested {_DEEPEST} deep; they are a list of names")
    if isinstance(names, list):
        return [name for part in names for name in _flat(part, deepest - 1)]
    if not isinstance(names, dict):
        return [] if names is None else [str(names)]
    groups = {key: value for key, value in names.items() if isinstance(value, list | dict)}
    if not groups:
        whole = all(isinstance(value, int) for value in names.values())
        return sorted(names, key=lambda key: int(names[key])) if whole else list(names)
    return [
        name if len(groups) == 1 else f"{key}.{name}"
        for key, value in groups.items()
        for name in _flat(value, deepest - 1)
    ]


def _digest(path: Path, files: list[Path]) -> str:
    """Return a digest of the data files, from the digest of each, since a dataset may be large."""
    whole = sha256_of(path / "meta" / "info.json")
    for file in files:
        whole.update(sha256_of(file).digest())
    return whole.hexdigest()
