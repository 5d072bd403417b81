"""Reads tables and trajectories from a path; the entry point of this package."""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from mcap.records import Chunk, Metadata

from deal_hw.data.files import INDEX_NAME
from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.columns import EFFORT_UNITS, ColumnMap, JointColumns, JointKinds, TimeColumn
from deal_hw.data.importing.guess import channels_of_joints, guess_columns, guess_time
from deal_hw.data.importing.guess_topics import guess_topics
from deal_hw.data.importing.repeats import without_repeats
from deal_hw.data.importing.sources import check_one_source
from deal_hw.data.importing.stamps import on_even_clock
from deal_hw.data.importing.table import build_table
from deal_hw.data.recording.schemas import METADATA_NAME
from deal_hw.data.table import Table, table_of
from deal_hw.documentation import page
from deal_hw.errors import DatasetError
from deal_hw.reading import reading

Say = Callable[[str], None]
MapOf = Callable[[Channels], ColumnMap | None]
"""Returns the column map of a file's channels; None: it is guessed."""
_CSV = "deal_hw.data.importing.csv_source:read_csv"
_READERS = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".csv.gz", ".tsv.gz", ".txt.gz"), _CSV),
    ".npz": "deal_hw.data.importing.npz_source:read_npz",
    **dict.fromkeys((".parquet", ".pq"), "deal_hw.data.importing.parquet_source:read_parquet"),
    **dict.fromkeys((".json", ".jsonl", ".ndjson"), "deal_hw.data.importing.json_source:read_json_table"),
    **dict.fromkeys((".h5", ".hdf5"), "deal_hw.data.importing.hdf5_source:read_hdf5"),
    ".mat": "deal_hw.data.importing.mat_source:read_mat",
    ".bag": "deal_hw.data.importing.ros1_source:read_ros1_bag",
    ".mcap": "deal_hw.data.importing.mcap_source:read_mcap",
    ".db3": "deal_hw.data.importing.bag_source:read_bag",
}
"""MODULE:FUNCTION that reads a file, imported on use, by the end of its name."""
_HEAD_BYTES = 1 << 20
SAME_EFFORT = 0.02
"""A motor of 1 N or N·m, within this, takes both kinds of command alike [N or N·m]."""


def read_channels(path: Path, say: Say | None = None) -> list[Channels]:
    """Read a file, a LeRobot folder, our own dataset or the folder of a ROS 2 bag; one entry per recording.

    Args:
        path: The file or folder.
        say: Called with a sentence on each episode of our own dataset that is left out.

    Raises:
        DatasetError: There is no such file, or its kind is unknown.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, say)
    if not path.exists():
        raise DatasetError(f"{path} does not exist; check its name")
    if is_episode(path):
        return [read_own(path)]
    reader = next((one for end, one in _READERS.items() if path.name.lower().endswith(end)), None)
    if reader is None:
        raise DatasetError(
            f"{path}: files ending in {path.suffix or 'nothing'!r} are not known; "
            f"known: {', '.join(_READERS)}, and LeRobot folders"
        )
    module, _, function = reader.partition(":")
    found = getattr(importlib.import_module(module), function)(path)
    return list(found) if isinstance(found, list) else [found]


def _read_folder(path: Path, say: Say | None) -> list[Channels]:
    from deal_hw.data.importing.lerobot_source import is_lerobot, read_lerobot

    if is_lerobot(path):
        return read_lerobot(path)
    if is_dataset(path):
        return [read_own(episode) for episode in own_episodes(path, say)]
    if (path / "metadata.yaml").is_file():
        from deal_hw.data.importing.bag_source import bag_files, read_bag

        if bags := bag_files(path):
            return [read_bag(bags[0] if len(bags) == 1 else path, bags)]
    raise DatasetError(
        f"{path} is a folder, but not a dataset, a LeRobot dataset (meta/info.json) or a ROS 2 bag "
        "(metadata.yaml beside .mcap or .db3 files); name a file"
    )


def load_tables(
    path: Path,
    columns: ColumnMap | MapOf | None = None,
    joints: Sequence[str] | None = None,
    say: Say | None = None,
    printed: dict[str, str] | None = None,
    kinds: JointKinds | None = None,
) -> list[Table]:
    """Read the recordings in a file, in SI units, on their own stamps.

    Args:
        path: A file of a known kind, our own episode, or the folder of our own dataset, of LeRobot's or of a
            ROS 2 bag.
        columns: Meaning of its channels, or what returns it; None: guessed from their names.
        joints: Names of the model's joints; None: those of the map, or of the file.
        say: Called with sentences on guesses and omissions.
        printed: Guessed maps that were printed already, each with the recording's name; a new one is added.
            One that is in it is not printed again.
        kinds: Which of the model's joints slide or have motors; None: unknown.

    Raises:
        DatasetError: It cannot be read or understood.
    """
    described = f"{page('how-to/import.md')} describes one"
    with reading(path, "a recording of a robot", described):
        tables = tables_of(read_channels(path, say), columns, joints, say, printed, kinds)
    if not tables:
        raise DatasetError(f"{path} holds no recording")
    return tables


def tables_of(
    recordings: Sequence[Channels],
    columns: ColumnMap | MapOf | None = None,
    joints: Sequence[str] | None = None,
    say: Say | None = None,
    printed: dict[str, str] | None = None,
    kinds: JointKinds | None = None,
) -> list[Table]:
    """Interpret channels, as :func:`load_tables` does for a file."""
    tables = []
    for number, channels in enumerate(recordings):
        mapped = columns(channels) if callable(columns) else columns
        led = frozenset[str]() if kinds is None else kinds.followers
        used = mapped or _guess(channels, joints, led, say)
        if kinds is not None:
            used = used.for_model(kinds)
        if say is not None:
            has = {joint.name for joint in used.joints}
            asked = joints if joints is None else [name for name in joints if name not in led or name in has]
            _tell(say, channels, used, asked, mapped is None and number == 0, printed)
        table = build_table(channels, used, joints)
        check_one_source(table)
        for fact, mended in (("repeats", without_repeats), ("stamps", on_even_clock)):
            table, text = mended(table)
            if text:
                table.source[fact] = text
            if text and say is not None:
                say(f"{table.name}: {text}")
        if unsaid := _unsaid(table, used):
            table.source["unsaid"] = unsaid
        if efforts := {j.name: j.target_unit for j in used.joints if j.target_unit in EFFORT_UNITS}:
            table.source["efforts"] = efforts
        if say is not None:
            _tell_turns(say, table)
        tables.append(table)
    return tables


def _unsaid(table: Table, columns: ColumnMap) -> str:
    """Return the question about a motor's commands that may be newtons as well as a share of full power.

    It is open where all commands of motors lie within -1..1, and the map does not say what 1 is; else "".
    """
    motors = {joint.name: joint for joint in columns.joints if joint.motor is not None}
    reach = {
        name: float(np.nanmax(np.abs(values)))
        for name, values in zip(table.actuated, table.target.T, strict=True)
        if name in motors and np.isfinite(values).any()
    }
    if not reach or max(reach.values()) > 1.0:
        return ""
    for name, furthest in reach.items():
        joint = motors[name]
        full = joint.motor
        if furthest > 0 and full is not None and joint.unit_unsaid and abs(full - 1.0) > SAME_EFFORT:
            unit = joint.effort_unit
            scale = f"{{from: [-1, 1], to: [-{full:.4g}, {full:.4g}]}}"
            return (
                f"the commands of {name} lie within -1..1, and its motor in the model gives {full:.4g} "
                f"{unit} at its highest command: 1 may be full power or 1 {unit}. Write into the column map "
                f"(--columns), for {name}, `target_normalised: {scale}` if it is full power, or "
                f"`target_unit: {unit}`"
            )
    return ""


def _tell_turns(say: Say, table: Table) -> None:
    for name, count in table.source.get("unwrapped", {}).items():
        say(
            f"{table.name}: the angle of {name} jumps by a full turn {count} times: it was folded into one "
            "turn, such as -pi..pi. It is unwrapped, so that nothing is interpolated across a jump"
        )


def own_episodes(path: Path, say: Say | None = None) -> list[Path]:
    """Return the used episodes of our own dataset, or the named one; none of any other file.

    Args:
        path: The file or folder.
        say: Called with a sentence on each repair, and on each episode that is left out.

    Raises:
        DatasetError: The dataset cannot be read, or all of its episodes are left out.
    """
    if is_dataset(path):
        from deal_hw.data.recording.dataset import Dataset

        dataset = Dataset.open(path, say or (lambda text: None))
        return [dataset.path(number) for number in dataset.used(say or (lambda text: None))]
    return [path] if is_episode(path) else []


def is_dataset(path: Path) -> bool:
    """Return whether a folder is a dataset of deal-hw."""
    return (Path(path) / INDEX_NAME).is_file()


def is_episode(path: Path) -> bool:
    """Return whether an MCAP file was written by deal-hw, which it states before its first message."""
    path = Path(path)
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    from deal_hw.data.recording.mcap_scan import FoundRecord, scan

    with open(path, "rb") as file:
        head = file.read(_HEAD_BYTES)
    for item in scan(head):
        if not isinstance(item, FoundRecord) or isinstance(item.record, Chunk):
            return False
        if isinstance(item.record, Metadata):
            return item.record.name == METADATA_NAME
    return False


def _guess(
    channels: Channels, joints: Sequence[str] | None, led: Collection[str], say: Say | None
) -> ColumnMap:
    topics = guess_topics(channels, joints)
    if topics is not None:
        return topics
    try:
        return guess_columns(channels, joints, followers=led)
    except DatasetError:
        if say is not None:
            asked = joints if joints is None else [name for name in joints if name not in led]
            _say_map(say, channels, asked, None)
        raise


_INCOMPLETE = "a column map to start from; save it as columns.yaml, and replace COLUMN:"
_GUESSED = (
    "no column map given; this one was guessed (to change it, save it and name it by --columns, in Python by "
    "columns=):"
)


def _say_map(
    say: Say,
    channels: Channels,
    joints: Sequence[str] | None,
    guessed: ColumnMap | None,
    title: str = _INCOMPLETE,
    printed: dict[str, str] | None = None,
) -> None:
    name = f"{channels.path.name} {channels.part}".strip()
    lines = starting_map(channels, joints, guessed)
    first = name if printed is None else printed.setdefault("\n".join([title, *lines]), name)
    if first != name:
        say(f"{name}: the same column map as {first}")
        return
    say(f"{name}: {title}")
    for line in lines:
        say(f"  {line}")


def _tell(
    say: Say,
    channels: Channels,
    columns: ColumnMap,
    joints: Sequence[str] | None,
    guessed: bool,
    printed: dict[str, str] | None,
) -> None:
    name = f"{channels.path.name} {channels.part}".strip()
    for note in channels.notes:
        say(f"{name}: {note}")
    if guessed:
        missing = [joint for joint in joints or () if joint not in {known.name for known in columns.joints}]
        if missing:
            say(f"{name}: not in the file: {', '.join(missing)}; its channels: {channels.listed()}")
        if not (columns.target or any(joint.target for joint in columns.joints)):
            say(f"{name}: no commanded positions found")
        _say_map(say, channels, joints, columns, _INCOMPLETE if missing else _GUESSED, printed)


def read_own(path: Path) -> Channels:
    """Read an episode: samples on device time, commands at the device time of their start.

    What comes after joints no longer followed their commands is left out.

    Raises:
        TornRecordingError: It has no footer or is damaged.
        DatasetError: It cannot be read.
    """
    from deal_hw.data.checks.following import followed_part, what_is_cut
    from deal_hw.data.recording.reader import read_trajectory

    trajectory = read_trajectory(path)
    cut = what_is_cut(trajectory)
    table = table_of(followed_part(trajectory), path.name)
    arrays = {
        "time_s": table.time_s,
        "position": table.position,
        "command_time_s": table.command_s,
        "target": table.target,
    }
    for name, values in (("velocity", table.velocity), ("effort", table.effort)):
        if values is not None:
            arrays[name] = values
    measured = dict.fromkeys(("position", "velocity", "effort"), table.joint_names)
    return Channels(
        path=path,
        kind="deal-hw",
        digest=digest_of_file(path),
        arrays=arrays,
        labels={name: joints for name, joints in measured.items() if name in arrays}
        | {"target": table.actuated},
        units={"position": table.units},
        notes=(cut,) if cut else (),
    )


COLUMN = "COLUMN"
"""Stands for a name that the user writes."""
_QUANTITIES = ("position", "target", "velocity", "effort")


def starting_map(
    channels: Channels, joints: Sequence[str] | None = None, guessed: ColumnMap | None = None
) -> list[str]:
    """Return the lines of a column map (YAML): the guessed entries, and :data:`COLUMN` for the others.

    Args:
        channels: The file's channels.
        joints: Names of the model's joints; None: unknown.
        guessed: The entries that were guessed; None: no complete map was.
    """
    time = guess_time(channels) if guessed is None else guessed.time
    if time is None:
        # The joints may be known although the time is not.
        with contextlib.suppress(DatasetError):
            guessed = guess_columns(channels, joints, TimeColumn(column=COLUMN))
    known = {} if guessed is None else {joint.name: joint for joint in guessed.joints}
    stamps = {"time": time, "command_time": guessed.command_time if guessed else None}
    lines = [
        f"{name}: {{column: {COLUMN if stamp is None else json.dumps(stamp.column)}, "
        f"unit: {'s' if stamp is None else stamp.unit}}}"
        for name, stamp in stamps.items()
        if stamp is not None or name == "time"
    ]
    for name in _QUANTITIES:
        pattern = getattr(guessed, name, None)
        if pattern is not None:
            lines.append(f"{name}: {json.dumps(pattern)}")
    names = joints or tuple(known) or ("JOINT",)
    partly = channels_of_joints(channels, time, joints)
    entries = [_entries(name, known.get(name), partly.get(name, {})) for name in names]
    return [*lines, "joints:", *(f"  - {{{entry}}}" for entry in entries)]


def _entries(name: str, joint: JointColumns | None, partly: Mapping[str, str]) -> str:
    if joint is None:
        position, target = (
            json.dumps(partly[key]) if key in partly else COLUMN for key in ("position", "target")
        )
        return f"name: {json.dumps(name)}, position: {position}, target: {target}, unit: rad"
    values = {
        key: getattr(joint, key) for key in ("name", "column", "index", *_QUANTITIES, "unit", "target_unit")
    }
    return ", ".join(
        f"{key}: {json.dumps(value)}" for key, value in values.items() if value not in (None, "")
    )
