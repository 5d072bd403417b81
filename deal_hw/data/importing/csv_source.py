"""Reads a CSV file: a line of names, one row per sample, numbers, times or lists of numbers in the cells."""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import json
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.csv_layout import BLANK, NOTHING, Layout, find_layout, is_comment
from deal_hw.data.importing.times import FirstDay, Times, is_time
from deal_hw.errors import DatasetError, short
from deal_hw.reading import NAMES, NUMBERS, RECORDING_BYTES, check_size, reading
from deal_hw.types import FloatArray

LINE = 1 << 20
"""Longest line [characters]; prevents reading a file without line ends at once."""
HEAD_LINES = 200
"""Lines in which a table must begin."""
HEAD_BYTES = 1 << 16
"""Bytes that show a file's encoding."""
GZIP = b"\x1f\x8b"
"""First bytes of a file that gzip packed."""
_MARKS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
"""Byte-order marks."""


def read_csv(path: Path, most_numbers: int = NUMBERS) -> Channels:
    """Read a CSV file, also one that gzip packed.

    Cells are separated by a comma, a semicolon, a tab, a bar or blanks; the rows show which. Comment lines
    start with ``#``, ``%`` or ``//``. A comma inside a cell is the decimal point. An empty cell is NaN. Times
    of day and dates become seconds. Columns of text are left out, and so are lines before the names; a line
    of units below them is read. An incomplete last row is left out with a note. Sizes are limited, see
    :mod:`deal_hw.reading`; ``most_numbers`` is the limit of numbers.

    Raises:
        DatasetError: It cannot be read, has no header, or a row does not fit it.
    """
    path = Path(path)
    with reading(path, "CSV"):
        check_size(path, RECORDING_BYTES)
        digest = digest_of_file(path)
        with open(path, "rb") as packed:
            is_gzip = packed.read(len(GZIP)) == GZIP
        with gzip.open(path) if is_gzip else open(path, "rb") as raw:
            encoding = _encoding(raw.read(HEAD_BYTES))
            raw.seek(0)
            # The names may have a letter of another encoding; in a number it is reported.
            with io.TextIOWrapper(raw, encoding=encoding, errors="replace", newline="") as file:
                return _parse(path, digest, file, most_numbers)


def _encoding(start: bytes) -> str:
    """Return the encoding of a text by its first bytes."""
    for mark, name in _MARKS.items():
        if start.startswith(mark):
            return name
    if b"\0" in start:
        for name, zeros in (("utf-16-le", start[1::2]), ("utf-16-be", start[::2])):
            if zeros.count(0) > len(zeros) // 2:
                return name
        raise ValueError(f"it begins with {start[:8]!r}: it is no text")
    try:
        # The last letter may be cut.
        start[: start.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


class _Lines(Iterator[str]):
    """The rows of a file: no comments, no empty lines; ``number`` is the last one's place in the file.

    Args:
        file: Its lines.
        most: Most characters of all of them.
    """

    def __init__(self, file: TextIO, most: int = RECORDING_BYTES) -> None:
        self._file, self._left = file, most
        self._head: list[str] = []
        self.number = 0
        self.blanks = False

    def head(self) -> list[str]:
        """Return the file's first lines; to be called before the first row is taken."""
        lines = itertools.islice(iter(self._read, ""), HEAD_LINES)
        size = 0
        for line in lines:
            self._head.append(line)
            size += len(line)
            if size > 2 * LINE:
                break
        return list(self._head)

    def skip_to(self, number: int) -> None:
        """Leave out the lines before this one of the head."""
        self.number = number - 1
        del self._head[: number - 1]

    def _read(self) -> str:
        line = self._file.readline(LINE)
        if len(line) == LINE and line[-1] != "\n":
            raise ValueError(f"a line of {LINE} characters or more")
        self._left -= len(line)
        if self._left < 0:
            raise ValueError("more text than a recording may have, once it is unpacked")
        return line

    def __next__(self) -> str:
        while line := self._head.pop(0) if self._head else self._read():
            self.number += 1
            if line.strip() and not is_comment(line):
                return BLANK.join(line.split()) if self.blanks else line
        raise StopIteration


def _parse(path: Path, digest: str, file: TextIO, most_numbers: int) -> Channels:
    lines = _Lines(file)
    layout = find_layout(path, lines.head())
    _check_names(path, layout)
    lines.skip_to(layout.rows)
    lines.blanks = layout.delimiter == BLANK
    width = len(layout.names)
    rows = csv.reader(lines, delimiter=layout.delimiter, skipinitialspace=True)
    day = FirstDay()
    columns = [
        _Column(path, name, day, most_numbers // width, place in layout.valued)
        for place, name in enumerate(layout.names)
    ]
    cut = 0
    for row in rows:
        if cut:
            raise DatasetError(f"{path}: line {cut} has fewer than {width} cells; repair the file")
        while len(row) > width and not row[-1].strip():
            row.pop()  # Some loggers write a delimiter after the last value, too.
        if len(row) < width:
            cut = lines.number  # Only the last row may be incomplete, from a killed writer.
            continue
        if len(row) > width:
            raise DatasetError(
                f"{path}: line {lines.number} has {len(row)} cells, but the header has {width} "
                f"(separated by {layout.delimiter!r}); repair the file"
            )
        for column, cell in zip(columns, row, strict=True):
            column.take(lines.number, cell)
    kept = [column for column in columns if not column.is_text]
    notes = [*layout.notes]
    if cut:
        notes.append(f"line {cut} is incomplete and left out")
    if text := [column.name for column in columns if column.is_text]:
        notes.append(f"columns of text are left out: {short(', '.join(text))}")
    units = dict(zip(layout.names, layout.units, strict=False))
    for column in kept:
        if column.is_time:
            notes.append(
                f"the times of {short(column.name, 60)!r}, such as {column.example!r}, are read as seconds"
            )
            units[column.name] = "s"
    return Channels(
        path=path,
        kind="csv",
        digest=digest,
        arrays={column.name: column.values() for column in kept},
        units={column.name: (units[column.name],) for column in kept if units.get(column.name)},
        notes=tuple(notes),
    )


def _check_names(path: Path, layout: Layout) -> None:
    names = layout.names
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


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class _Column:
    """Collects the cells of one column; its first cell decides the kind: a number, a time, a list or text.

    Text is an error in a column that has values in most rows.
    """

    def __init__(self, path: Path, name: str, day: FirstDay, most: int, valued: bool) -> None:
        self.name = name
        self.is_text = self.is_time = False
        self.example = ""
        self._path = path
        self._most = most
        self._valued = valued
        self._times = Times(day)
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
        if text.lower() in NOTHING:
            self._numbers.extend([float("nan")] * max(self._width, 1))
            return
        try:
            if self._width or (not self._seen and text.startswith("[")):
                self._take_list(text)
            elif self.is_time or (not self._seen and is_time(text)):
                self._numbers.append(self._times.seconds(text))
                self.is_time, self.example = True, self.example or short(text, 40)
            else:
                self._numbers.append(float(text.replace(",", ".")))
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            if not (self._seen or self._valued):
                self.is_text = True
                return
            wanted = "a time" if self.is_time else "a number"
            if self._width:
                wanted = f"a list of {self._width} numbers"
            if self.is_time and str(error) != "no time":
                wanted = f"a time: {error}"
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
