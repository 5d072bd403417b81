"""CSV files of values by time: the requested velocity of a walk, the poses of an arm."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from deal_hw.errors import ConfigurationError, shown
from deal_hw.reading import MIB, check_size, reading

TIME: Final = "time_s"


def read_script(path: Path, columns: Sequence[str]) -> list[tuple[int, list[float]]]:
    """Read a script: a header, then lines of a time and values.

    Args:
        path: The file.
        columns: Names of the columns behind ``time_s``, in order.

    Returns:
        Line number and the line's numbers, at least one line; times are finite and grow, values are numbers.

    Raises:
        ConfigurationError: It cannot be read, or a line is wrong; the message names it.
    """
    names = [TIME, *columns]
    with reading(f"the script {path}", "CSV", error=ConfigurationError):
        check_size(path, MIB)
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.reader(file)
            head = next(reader, [])
            lines = [(reader.line_num, line) for line in reader if line]
    if [name.strip() for name in head] != names:
        raise ConfigurationError(
            f"{path}: its first line is {shown(','.join(head))}, expected {','.join(names)}"
        )
    rows: list[tuple[int, list[float]]] = []
    for number, line in lines:
        try:
            row = [float(part) for part in line]
        except ValueError:
            row = []
        if len(row) != len(names) or not math.isfinite(row[0]) or (rows and row[0] <= rows[-1][1][0]):
            raise ConfigurationError(
                f"{path}: line {number} is {shown(','.join(line))}; expected {len(names)} numbers, with "
                "increasing times"
            )
        rows.append((number, row))
    if not rows:
        raise ConfigurationError(f"{path} contains no line after its header; add lines of {','.join(names)}")
    return rows
