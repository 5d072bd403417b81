"""Reads a JSON file: an object of columns, or a list of records, also one record a line."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.data.importing.arrays import channels_of_arrays, unwanted
from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.times import FirstDay, Times, is_time
from deal_hw.errors import DatasetError, short
from deal_hw.reading import MIB, NAMES, read_bytes, reading

JSON_BYTES: Final = 128 * MIB
"""Largest file: half an hour of 7 joints at 100 Hz takes 30 MiB. Its values take up to ten times that in
memory."""
_DEEPEST: Final = 8


def read_json_table(path: Path) -> Channels:
    """Read ``{"time": [...], "a_pos": [...]}``, or ``[{"time": 0, "a_pos": 0.1}, ...]``, also by lines.

    Lists in cells become arrays, nested objects dotted names. What pandas writes with ``to_json`` is read in
    each of its orientations but "values", which names nothing. A list of texts beside the columns names the
    joints.

    Raises:
        DatasetError: It cannot be read, or is no table.
    """
    path = Path(path)
    with reading(path, "JSON", 'a recording is {"time": [...], "elbow_pos": [...]}, or a list of records'):
        text = read_bytes(path, JSON_BYTES).decode("utf-8-sig")
        digest = digest_of_file(path)
        try:
            values = json.loads(text)
        except json.JSONDecodeError:
            lines = [line for line in text.splitlines() if line.strip()]
            if len(lines) < 2 or not all(line.lstrip().startswith("{") for line in lines):
                raise
            values = [json.loads(line) for line in lines]
        columns = _columns(path, values)
        day = FirstDay()
        found: dict[str, np.ndarray[Any, Any]] = {}
        units: dict[str, str] = {}
        left_out: dict[str, str] = {}
        for name, cells in columns.items():
            array, why = _array(cells, day)
            if array is None:
                left_out[name] = why
                continue
            found[name] = array
            if why:
                units[name] = why
        return channels_of_arrays(path, "json", digest, found, left_out, units)


def _columns(path: Path, values: Any) -> dict[str, list[Any]]:
    """Return the cells of each column of a table."""
    if isinstance(values, Mapping) and {"columns", "data"} <= values.keys():
        values = [dict(zip(map(str, values["columns"]), row, strict=True)) for row in values["data"]]
    if isinstance(values, Mapping) and isinstance(values.get("data"), list) and "schema" in values:
        values = values["data"]
    if isinstance(values, Mapping) and values and all(key.isdigit() for key in values):
        values = list(values.values())
    if isinstance(values, list) and values and all(isinstance(row, Mapping) for row in values):
        rows = [dict(_flat(row)) for row in values]
        names = dict.fromkeys(name for row in rows for name in row)
        if len(names) > NAMES:
            raise DatasetError(f"{path} has {len(names)} columns; {NAMES} are allowed")
        return {name: [row.get(name) for row in rows] for name in names}
    if isinstance(values, Mapping):
        columns = {name: cells for name, cells in _flat(values) if isinstance(cells, list)}
        if any(len(cells) > 1 for cells in columns.values()):
            return columns
    shown = (
        f"an object with {short(', '.join(map(str, values)), 100)}"
        if isinstance(values, Mapping)
        else "no object"
    )
    raise DatasetError(f"{path} holds no table: it is {shown}")


def _flat(values: Mapping[str, Any], prefix: str = "", deepest: int = _DEEPEST) -> list[tuple[str, Any]]:
    """Return the entries of nested objects by dotted names; an object of numbered cells is a column."""
    found: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value and all(name.isdigit() for name in value):
            value = list(value.values())
        if isinstance(value, Mapping) and deepest:
            found += _flat(value, f"{prefix}{key}.", deepest - 1)
        else:
            found.append((f"{prefix}{key}", value))
    return found


def _array(cells: Sequence[Any], day: FirstDay) -> tuple[np.ndarray[Any, Any] | None, str]:
    """Return a column as an array with its unit; or None, and why it is left out."""
    known = [cell for cell in cells if cell is not None]
    if known and all(isinstance(cell, str) for cell in known):
        if all(map(is_time, known)) and len(known) == len(cells):
            times = Times(day)
            return np.array([times.seconds(cell) for cell in cells]), "s"
        array = np.array(known)
    else:
        width = next((len(cell) for cell in known if isinstance(cell, list)), 0)
        empty = [float("nan")] * width if width else float("nan")
        try:
            array = np.array([empty if cell is None else cell for cell in cells], dtype=np.float64)
        except (TypeError, ValueError):
            return None, "its cells are no numbers, or lists of different lengths"
    why = unwanted(array.dtype, array.shape)
    return (None, why) if why else (array, "")
