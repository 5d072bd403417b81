"""Reads a CSV file: one header line, one row a sample, numbers or lists of numbers in the cells."""

from __future__ import annotations

import csv
import json
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray

_NOTHING = {"", "nan", "null", "none", "na", "n/a", "-"}


def read_csv(path: Path) -> Channels:
    """Read a CSV file; the delimiter is a comma, a semicolon or a tab, comment lines start with ``#``.

    With a semicolon, a comma is read as the decimal point. An empty cell is NaN. Columns of text are left
    out. A last row that is cut off is left out with a note.

    Raises:
        DatasetError: It cannot be read, has no header, or a row does not fit it.
    """
    path = Path(path)
    digest = digest_of_file(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            arrays, notes = _parse(path, (line for line in file if line.strip() and line[0] != "#"))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path} cannot be read as CSV: {error}") from error
    return Channels(path=path, kind="csv", digest=digest, arrays=arrays, notes=notes)


def _parse(path: Path, lines: Iterator[str]) -> tuple[dict[str, FloatArray], tuple[str, ...]]:
    header = next(lines, None)
    if header is None:
        raise DatasetError(f"{path} is empty; a CSV file starts with a line that names its columns")
    delimiter = max(",;\t", key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter))]
    if len(set(names)) != len(names) or all(_is_number(name) for name in names):
        raise DatasetError(
            f"{path}: the first line must name the columns, each once, such as time,elbow_pos,elbow_target"
        )
    rows = csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    columns = [_Column(path, name, delimiter == ";") for name in names]
    short = 0
    for number, row in enumerate(rows, start=1):
        if short:
            raise DatasetError(f"{path}: row {short} has fewer than {len(names)} cells; mend the file")
        if len(row) < len(names):
            short = number  # Only the last one may be: the writer was killed.
            continue
        if len(row) > len(names):
            raise DatasetError(
                f"{path}: row {number} has {len(row)} cells, the header {len(names)} ({delimiter!r} between)"
            )
        for column, cell in zip(columns, row, strict=True):
            column.take(number, cell)
    arrays = {column.name: column.values() for column in columns if not column.is_text}
    notes = [f"row {short} is cut off and left out"] if short else []
    text = [column.name for column in columns if column.is_text]
    if text:
        notes.append(f"columns of text are left out: {', '.join(text)}")
    return arrays, tuple(notes)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class _Column:
    """Collects the cells of one column; what its first cell is decides: a number, a list or text."""

    def __init__(self, path: Path, name: str, comma_is_point: bool) -> None:
        self.name = name
        self.is_text = False
        self._path = path
        self._comma = comma_is_point
        self._numbers = array("d")
        self._width = 0
        self._seen = False

    def take(self, row: int, cell: str) -> None:
        """Add a cell."""
        if self.is_text:
            return
        text = cell.strip()
        if text.lower() in _NOTHING:
            self._numbers.extend([float("nan")] * max(self._width, 1))
            return
        try:
            if self._width or (not self._seen and text.startswith("[")):
                self._take_list(text)
            else:
                self._numbers.append(float(text.replace(",", ".") if self._comma else text))
        except ValueError as error:
            if not self._seen:
                self.is_text = True
                return
            raise DatasetError(
                f"{self._path}: row {row}, column {self.name!r} holds {cell!r}, not a number; mend the file"
            ) from error
        self._seen = True

    def _take_list(self, text: str) -> None:
        values: Sequence[float] = [float(value) for value in json.loads(text)]
        if not self._width:
            # Empty cells came before: each stood for one number until now.
            self._numbers = array("d", [float("nan")] * len(self._numbers) * len(values))
            self._width = len(values)
        if len(values) != self._width or not values:
            raise ValueError(f"{len(values)} numbers, {self._width} before")
        self._numbers.extend(values)

    def values(self) -> FloatArray:
        """Return what was collected, (T,) or (T, K)."""
        flat = np.frombuffer(self._numbers, dtype=np.float64) if self._numbers else np.empty(0)
        return flat.reshape(-1, self._width) if self._width else flat
