"""What the measuring scripts share: options, rows that are kept after each run, and tables.

A script makes its options with :func:`parser`, measures a row at a time, and gives each to :class:`Rows`. The
file then has the command, commit, machine and versions in its head, and is whole after each row, so that a
stopped measurement loses one row at most.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import describe_call, load_rows, noted_in, write_rows
from deal_hw.types import FloatArray

Row = dict[str, Any]


def parser(doc: str | None, *, out: bool = True, table: bool = False) -> argparse.ArgumentParser:
    """Return a parser that shows a script's docstring as it is written.

    Args:
        doc: The docstring.
        out: Add `--out FILE.json`.
        table: Add `--table FILE.json`, for a script that can print its table without measuring.
    """
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if out:
        made.add_argument("--out", type=Path, help="write the rows to this JSON file, too")
    if table:
        made.add_argument("--table", type=Path, metavar="FILE", help="print the table of such a file")
    return made


def add_seeds(made: argparse.ArgumentParser, *default: int) -> None:
    """Add `--seeds`, numbers and ranges such as 1,2,3 or 1000-1009."""
    from deal_hw.workflows.options import parse_seeds

    made.add_argument("--seeds", type=parse_seeds, default=default, help="such as 1,2,3 or 1000-1009")


class Rows:
    """The rows of a measurement; the file is written after each.

    Args:
        script: ``__file__`` of the script, for the file's head.
        out: The file; None to write none.
        names: Fields that identify a row. With them, rows of an earlier call that are in the file stay.
    """

    def __init__(self, script: str, out: Path | None, names: Sequence[str] = ()) -> None:
        self._program, self._out, self._names = program(script), out, names
        self.rows: list[Row] = load_rows(out) if names and out is not None else []

    def done(self, *key: Any) -> bool:
        """Return whether a row with these values of the names is there, without an error."""
        return any(key == tuple(row[name] for name in self._names) for row in self.rows if not row["error"])

    def add(self, row: Row, printed: str | None = None, *, table: bool = False) -> None:
        """Keep a row and print it.

        Args:
            row: The row.
            printed: What is printed; by default the row as JSON; "" prints nothing.
            table: The script ends with a table on its output, so this goes to stderr.
        """
        self.rows.append(row)
        if printed != "":
            print(printed or json.dumps(row), file=sys.stderr if table else None, flush=True)
        self._write()

    def measured(self, key: Row, name: str, measure: Callable[[], Row], words: Callable[[Row], str]) -> None:
        """Measure a row that is not there yet, keep it, and print it; one that fails has its error.

        Args:
            key: Its values of the names, in their order.
            name: What is measured, for the line that is printed.
            measure: Returns its other fields.
            words: Returns what is printed of a row without an error.
        """
        if self.done(*key.values()):
            return
        row: Row = {**key, "error": ""}
        with noted_in(row):
            row |= measure()
        self.add(row, f"{name}: {row['error'] or words(row)}")

    def keep(self, rows: Sequence[Row]) -> None:
        """Keep rows that were measured together, and print nothing."""
        self.rows += rows
        self._write()

    def _write(self) -> None:
        if self._out is not None:
            write_rows(self._out, self.rows, program=self._program)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a file that a script wrote."""
    rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return rows


def program(script: str) -> str:
    """Return the name of a script in the head of its file, by its ``__file__``."""
    return f"tools/{Path(script).name}"


def head(script: str, *, dated: bool = False) -> Row:
    """Return the head of a file that is no list of rows: machine and command, and the time [UTC] if asked."""
    date = {"date": datetime.now(timezone.utc).isoformat(timespec="seconds")} if dated else {}
    return {**describe_call(program(script)), **date}


def write_document(out: Path | None, values: Mapping[str, Any]) -> None:
    """Write a file that is no list of rows; nothing where none is named."""
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(values, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def markdown(heads: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Return a table in Markdown."""
    return "\n".join([line(*heads), "|---" * len(heads) + "|", *(line(*cells) for cells in lines)])


def line(*cells: Any) -> str:
    """Return a line of a table in Markdown."""
    return "".join(f"| {cell} " if cell != "" else "| " for cell in cells) + "|"


def spread(values: Sequence[float] | FloatArray, unit: str = "") -> dict[str, float]:
    """Return p50, p99 and max, with a unit behind these names; nan without values."""
    found = np.percentile(values if len(values) else [np.nan], (50, 99, 100))
    return {f"{name}{unit}": round(float(v), 3) for name, v in zip(("p50", "p99", "max"), found, strict=True)}


def load() -> float:
    """Return the average number of running programs over the last minute."""
    return round(os.getloadavg()[0], 1)


def hear_signals() -> None:
    """Take Ctrl-C, SIGQUIT and SIGHUP as usual.

    A shell makes a background program ignore Ctrl-C, and nohup SIGHUP; all its children would inherit this.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
