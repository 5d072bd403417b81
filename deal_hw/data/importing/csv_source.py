"""Reads a CSV file: one header line, one row per sample, numbers or lists of numbers in the cells."""

from __future__ import annotations

import csv
import json
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.errors import DatasetError, short
from deal_hw.reading import NAMES, NUMBERS, RECORDING_BYTES, check_size, reading
from deal_hw.types import FloatArray

LINE = 1 << 20
"""Longest line [characters]; prevents reading a file without line ends at once."""
_NOTHING = {"", "nan", "null", "none", "na", "n/a", "-"}


def read_csv(path: Path, most_numbers: int = NUMBERS) -> Channels:
    """Read a CSV file; the delimiter is a comma, a semicolon or a tab, comment lines start with ``#``.

    With a semicolon, a comma is read as the decimal point. An empty cell is NaN. Columns of text are left
    out. An incomplete last row is left out with a note. Sizes are limited, see :mod:`deal_hw.reading`;
    ``most_numbers`` is the limit of numbers.

    Raises:
        DatasetError: It cannot be read, has no header, or a row does not fit it.
    """
    path = Path(path)
    with reading(path, "CSV"):
        check_size(path, RECORDING_BYTES)
        digest = digest_of_file(path)
        with open(path, newline="", encoding="utf-8-sig") as file:
            arrays, notes = _parse(path, _Lines(file), most_numbers)
    return Channels(path=path, kind="csv", digest=digest, arrays=arrays, notes=notes)


class _Lines(Iterator[str]):
    """The lines of a file without comments and empty ones; ``number`` is the last one's place in the file."""

    def __init__(self, file: TextIO) -> None:
        self._file, self.number = file, 0

    def __next__(self) -> str:
        while line := self._file.readline(LINE):
            self.number += 1
            if len(line) == LINE and line[-1] != "\n":
                raise ValueError(f"a line of {LINE} characters or more")
            if line.strip() and line[0] != "#":
                return line
        raise StopIteration


def _parse(path: Path, lines: _Lines, most_numbers: int) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    header = next(lines, None)
    if header is None:
        raise DatasetError(f"{path} is empty; a CSV file starts with a line that names its columns")
    delimiter = max(",;\t", key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter))]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled or all(_is_number(name) for name in names):
        found = (
            f"there more than once: {short(', '.join(map(repr, doubled)), 80)}"
            if doubled
            else "it has numbers"
        )
        raise DatasetError(
            f"{path}: the first line must name the columns, each once, such as time,elbow_pos,elbow_target; "
            f"{found}"
        )
    if len(names) > NAMES:
        raise DatasetError(f"{path} has {len(names)} columns; {NAMES} are allowed")
    rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    columns = [_Column(path, name, delimiter == ";", most_numbers // len(names)) for name in names]
    cut = 0
    for row in rows:
        if cut:
            raise DatasetError(f"{path}: line {cut} has fewer than {len(names)} cells; repair the file")
        if len(row) < len(names):
            cut = lines.number  # Only the last row may be incomplete, from a killed writer.
            continue
        if len(row) > len(names):
            raise DatasetError(
                f"{path}: line {lines.number} has {len(row)} cells, but the header has {len(names)} "
                f"(separated by {delimiter!r}); repair the file"
            )
        for column, cell in zip(columns, row, strict=True):
            column.take(lines.number, cell)
    arrays = {column.name: column.values() for column in columns if not column.is_text}
    notes = [f"line {cut} is incomplete and left out"] if cut else []
    text = [column.name for column in columns if column.is_text]
    if text:
        notes.append(f"columns of text are left out: {short(', '.join(text))}")
    return arrays, tuple(notes)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class _Column:
    """Collects the cells of one column; its first cell decides the kind: a number, a list or text."""

    def __init__(self, path: Path, name: str, comma_is_point: bool, most: int) -> None:
        self.name = name
        self.is_text = False
        self._path = path
        self._most = most
        self._comma = comma_is_point
        self._numbers = array("d")
        self._width = 0
        self._seen = False

    def take(self, line: int, cell: str) -> None:
        """Add a cell."""
        if self.is_text:
            return
        text = cell.strip()
        if len(self._numbers) >= self._most:
            raise DatasetError(
                f"{self._path}: column {short(self.name, 60)!r} has more than {self._most} numbers; "
                "cut the file"
            )
        if text.lower() in _NOTHING:
            self._numbers.extend([float("nan")] * max(self._width, 1))
            return
        try:
            if self._width or (not self._seen and text.startswith("[")):
                self._take_list(text)
            else:
                self._numbers.append(float(text.replace(",", ".") if self._comma else text))
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            if not self._seen:
                self.is_text = True
                return
            wanted = f"a list of {self._width} numbers" if self._width else "a number"
            raise DatasetError(
                f"{self._path}: line {line}, column {short(self.name, 60)!r} contains {short(cell, 60)!r}, "
                f"not {wanted}; repair the file"
            ) from error
        self._seen = True

    def _take_list(self, text: str) -> None:
        cells = json.loads(text)
        if not isinstance(cells, list) or not all(type(value) in (int, float) for value in cells):
            raise TypeError("not a list of numbers")
        values: Sequence[float] = [float(value) for value in cells]
        if not self._width:
            if len(self._numbers) * len(values) > self._most:
                raise ValueError("too many empty cells before so long a list")
            # Earlier empty cells counted as one number each until now.
            self._numbers = array("d", [float("nan")] * len(self._numbers) * len(values))
            self._width = len(values)
        if len(values) != self._width or not values:
            raise ValueError(f"{len(values)} numbers, {self._width} before")
        self._numbers.extend(values)

    def values(self) -> FloatArray:
        """Return what was collected, (T,) or (T, K)."""
        flat = np.frombuffer(self._numbers, dtype=np.float64) if self._numbers else np.empty(0)
        return flat.reshape(-1, self._width) if self._width else flat
