"""Finds how a text file lays out its table: the delimiter, the line of the names, a line of units.

Loggers and spreadsheets put lines before a table: a title, ``sep=;``, comments, a date. The table itself
shows where it begins: its rows have one number of cells, and most of these are numbers.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from deal_hw.data.importing.times import is_time
from deal_hw.errors import DatasetError, short

COMMENTS: Final = ("#", "%", "//")
"""Beginnings of a line that is no row."""
BLANK: Final = " "
"""Stands for any number of blanks and tabs between two cells."""
DELIMITERS: Final = (",", ";", "\t", "|", BLANK)
SEEN_ROWS: Final = 20
"""Last rows of a file's beginning that show the table's form."""
NOTHING: Final = frozenset({"", "nan", "null", "none", "na", "n/a", "-"})
"""Cells without a value, in lower case."""
_TOLD: Final = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_NUMBER: Final = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE)
_LIST: Final = re.compile(r"\[\s*[-+.\d]")
_BRACKETS: Final = re.compile(r"[\[({<](.*)[\])}>]")
_UNIT: Final = re.compile(
    r"[munµ]?s(ec)?|secs?|seconds?|(rad|deg|°|degrees?|radians?|m|mm|cm)(/s|/s\^?2|/s²|/sec)?|rpm|rev|turns?|ticks?|counts?|"
    r"k?N|m?Nm|N[*·. ]?m|m?A|m?V|W|%|1|°?C|Hz|g|[munµ]?[sS]econds?|milliseconds?|microseconds?|nanoseconds?"
)


@dataclass(frozen=True, slots=True)
class Layout:
    """The form of a table in a text file.

    Attributes:
        delimiter: Between two cells; :data:`BLANK` for any number of blanks and tabs.
        names: Of the columns.
        units: Of the columns, "" where none is given; () without a line of units.
        valued: The columns that have values in most of the first rows, from 0.
        rows: Number of the first line of the file that may be a row.
        notes: What was left out.
    """

    delimiter: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    valued: tuple[int, ...]
    rows: int
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Line:
    """Cells of one line, with its number in the file."""

    number: int
    cells: tuple[str, ...]


def find_layout(path: object, head: Sequence[str]) -> Layout:
    """Return the form of the table that a file begins with.

    Args:
        path: The file's name in messages.
        head: Its first lines, all of them from line 1 on.

    Raises:
        DatasetError: No line names the columns.
    """
    told = [match[1] for text in head[:1] if (match := _TOLD.fullmatch(text.strip()))]
    numbered = [(number, text) for number, text in enumerate(head, 1) if text.strip()][len(told) :]
    plain = [(number, text) for number, text in numbered if not is_comment(text)]
    if not plain:
        raise DatasetError(f"{path} is empty; a CSV file starts with a line that names its columns")
    delimiter = max(told or DELIMITERS, key=lambda one: _fits(plain, one))
    lines = [_Line(number, split(text, delimiter)) for number, text in plain]
    width = _width(lines)
    valued = _valued(lines, width)
    first = next((line.number for line in lines if len(line.cells) >= width and _is_row(line, valued)), None)
    before = lines if first is None else [line for line in lines if line.number < first]
    named = _names(before, width)
    if named is None:
        comments = [(n, text) for n, text in numbered if is_comment(text) and (first is None or n < first)]
        stripped = [_Line(n, split(text.lstrip("#%/ "), delimiter)) for n, text in comments]
        named = _names(stripped, width)
    if named is None:
        raise _unnamed(path, before, width, first, delimiter)
    between = [line for line in before if line.number > named.number]
    rows = named.number + 1 if first is None else first
    units: tuple[str, ...] = ()
    notes = []
    for line in between:
        if any(map(is_value, line.cells)) or not _filled(line, valued):
            # A row without values, or with a broken cell, which whoever reads the rows names.
            rows = line.number
            break
        if not units and len(line.cells) == width and _are_units(line.cells):
            units = tuple(_bare(cell) for cell in line.cells)
            notes.append(f"line {line.number} holds the units: {short(', '.join(units), 80)}")
        else:
            notes.append(f"line {line.number} is no row, and left out: {short(', '.join(line.cells), 80)}")
    above = [line for line in before if line.number < named.number]
    if above:
        texts = dict(plain)
        notes.append(
            f"the lines before line {named.number}, which names the columns, are left out: "
            f"{short('; '.join(texts[line.number].strip() for line in above), 80)}"
        )
    names = tuple(cell.strip() for cell in named.cells)
    names = names[: len(names) - _trailing(names)]
    return Layout(delimiter, names, units, tuple(valued), rows, tuple(notes))


def split(text: str, delimiter: str) -> tuple[str, ...]:
    """Return the cells of one line, without blanks around them."""
    if delimiter == BLANK:
        text = BLANK.join(text.split())
    try:
        cells = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return ()
    return tuple(cell.strip() for cell in cells)


def is_comment(text: str) -> bool:
    """Return whether a line is a comment."""
    return text.startswith(COMMENTS)


def is_value(cell: str) -> bool:
    """Return whether a cell is a number, a time or a list; a cell without a value is none."""
    return bool(_NUMBER.fullmatch(cell)) or bool(_LIST.match(cell)) or is_time(cell)


def _trailing(cells: Sequence[str]) -> int:
    """Return how many empty cells a line ends with: some loggers write a delimiter after each value."""
    return next((k for k, cell in enumerate(reversed(cells)) if cell), len(cells))


def _fits(plain: Sequence[tuple[int, str]], delimiter: str) -> tuple[float, int]:
    """Return how well a delimiter explains the last of some lines: share of values among cells, and width."""
    lines = [_Line(number, split(text, delimiter)) for number, text in plain[-SEEN_ROWS:]]
    width = _width(lines)
    cells = [cell for line in lines if len(line.cells) == width for cell in line.cells]
    filled = [cell for cell in cells if cell.lower() not in NOTHING]
    if width < 2 or not filled:
        return 0.0, width
    whole = sum(len(line.cells) == width for line in lines) / len(lines)
    return whole * sum(map(is_value, filled)) / len(filled), width


def _width(lines: Sequence[_Line]) -> int:
    """Return the number of cells of most of the last lines, without empty ones at the end."""
    counts = Counter(len(line.cells) - _trailing(line.cells) for line in lines[-SEEN_ROWS:])
    return max(counts, key=lambda width: (counts[width], width))


def _valued(lines: Sequence[_Line], width: int) -> list[int]:
    """Return the columns that have values in most of the last lines that have any."""
    last = [line.cells for line in lines[-SEEN_ROWS:] if len(line.cells) >= width]
    last = [cells for cells in last if any(map(is_value, cells))]
    return [
        column for column in range(width) if 2 * sum(is_value(cells[column]) for cells in last) >= len(last)
    ]


def _filled(line: _Line, valued: Sequence[int]) -> list[str]:
    """Return the cells of these columns that are not empty."""
    cells = [line.cells[column] for column in valued if column < len(line.cells)]
    return [cell for cell in cells if cell.lower() not in NOTHING]


def _is_row(line: _Line, valued: Sequence[int]) -> bool:
    """Return whether a line has values in the columns of values."""
    filled = _filled(line, valued)
    return bool(filled) and all(map(is_value, filled))


def _names(lines: Sequence[_Line], width: int) -> _Line | None:
    """Return the line with a name for each column; of several, the first with the most different ones."""
    named = [line for line in lines if len(line.cells) - _trailing(line.cells) == width]
    # A table without rows has its names alone.
    return max(named, key=lambda line: len({*line.cells} - {""}), default=None)


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell.lower() not in NOTHING]
    return bool(filled) and 2 * sum(bool(_UNIT.fullmatch(_bare(cell))) for cell in filled) > len(filled)


def _bare(cell: str) -> str:
    """Return a unit without the brackets around it."""
    match = _BRACKETS.fullmatch(cell)
    return (match[1] if match else cell).strip()


def _unnamed(
    path: object, before: Sequence[_Line], width: int, first: int | None, delimiter: str
) -> DatasetError:
    """Return the error where no line names the columns."""
    if not before:
        return DatasetError(
            f"{path}: the first line must name the columns, each once, such as "
            "time,elbow_pos,elbow_target; it has numbers"
        )
    header = before[-1]
    comma = (
        ". If its numbers have decimal commas, save the file with semicolons between the cells"
        if delimiter == "," and width >= 2 * len(header.cells) - 1
        else ""
    )
    return DatasetError(
        f"{path}: line {first} has {width} cells, but the header in line {header.number} has "
        f"{len(header.cells)} (separated by {delimiter!r}){comma}; repair the file"
    )
