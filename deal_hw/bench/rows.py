"""Rows of a bench: missing cells are run, and each row is stored at once, with the machine."""

from __future__ import annotations

import contextlib
import csv
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from deal_hw.calibration import CalibrationResult
from deal_hw.data.files import write_json
from deal_hw.data.run_folder import git_commit, versions
from deal_hw.errors import DatasetError, DealHwError, TaskLostError, shown
from deal_hw.reading import read_json
from deal_hw.task_map import InThisProcess, TaskMap
from deal_hw.types import FloatArray

FORMAT = "deal_hw.bench/1"

Row = dict[str, Any]
Spec = tuple[tuple[Any, ...], tuple[Any, ...]]
"""A cell that is to be run: the values that identify it, and its arguments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cells:
    """The cells of a bench.

    Attributes:
        names: Fields of a row that identify it.
        run: Runs a cell from its arguments; bound to it is what all cells share.
        args: For each cell the values of these fields, and the arguments.
        tasks: Does the cells: one after the other here, or in workers.
        bench: Name of the bench, for the rows of cells whose workers ended.
        whole: Whether a row without an error has all that is measured now. If it has not, its cell is run
            with the row as one more argument, and returns the row that takes its place.
    """

    names: Sequence[str]
    run: Callable[..., Row]
    args: Sequence[Spec]
    tasks: TaskMap = field(default_factory=InThisProcess)
    bench: str = ""
    whole: Callable[[Row], bool] = lambda row: True

    def missing(self, rows: Sequence[Row]) -> list[Spec]:
        """Return what is still to be run beside the rows that a file holds."""
        valid = {self.key(row): row for row in rows if not row["error"] and not row.get("skipped")}
        part = {cell: (row,) for cell, row in valid.items() if not self.whole(row)}
        return [
            (cell, (*args, *part.get(cell, ())))
            for cell, args in self.args
            if cell not in valid or cell in part
        ]

    def key(self, row: Row) -> tuple[Any, ...]:
        """Return what identifies a row; "" for a field that it lacks."""
        return tuple(row.get(name, "") for name in self.names)


@dataclass(frozen=True, slots=True, kw_only=True)
class RowTable:
    """A bench: what it runs and how it is shown.

    Attributes:
        cells: What it runs.
        line: Returns a row as one line of text.
        summary: Prints a summary of the rows without errors.
        draw: Draws the rows without errors, at least one, into a file; None: there is no figure.
    """

    cells: Cells
    line: Callable[[Row], str]
    summary: Callable[[Sequence[Row]], None]
    draw: Callable[[Path, Sequence[Row]], None] | None = None


@contextlib.contextmanager
def noted_in(row: Row) -> Iterator[None]:
    """Note an error in the row of a cell, so that the other cells still run."""
    try:
        yield
    except DealHwError as err:
        row["error"] = f"{type(err).__name__}: {err}"


def printed(summary: Callable[[Sequence[Row]], Sequence[str]]) -> Callable[[Sequence[Row]], None]:
    """Return a function that prints the lines of a summary."""
    return lambda rows: print("\n".join(summary(rows)))


def run_cells(
    cells: Cells, out: Path, after: Callable[[str, Row, list[Row]], None], program: str = "deal-hw"
) -> list[Row]:
    """Run the cells without a valid, whole row in a file, writing the file after each; return all rows.

    Rows are written in the order of the cells, in whichever order they end. A Ctrl-C ends the cells that have
    begun; the rows of those that have ended are kept.

    Args:
        cells: The cells.
        out: File of the rows; the CSV is beside it.
        after: Called after each cell with the number of those that are done, such as "2/10", its row and all
            rows.
        program: Name of the command, for the file's head.

    Raises:
        DatasetError: The file holds something else.
        ClusterError: The workers cannot be used.
    """
    earlier = rows = load_rows(out)
    missing = cells.missing(rows)
    if not missing:
        return rows

    def lost(cell: tuple[Any, ...], why: TaskLostError) -> Row:
        # The other cells still run. What was to be completed keeps its numbers.
        head = {"bench": cells.bench, **dict(zip(cells.names, cell, strict=True))}
        known = next((row for row in earlier if cells.key(row) == cell), {})
        return {**known, **head, "error": f"{type(why).__name__}: {why}"}

    found: dict[int, Row] = {}
    with cells.tasks as tasks, contextlib.ExitStack() as stack:
        # A cell that has ended is in the file before the next one is asked for.
        run = partial(_run_cell, cells.run)
        ended = stack.enter_context(
            contextlib.closing(tasks.completed(run, missing, lambda spec, why: lost(spec[0], why)))
        )
        for index, row in ended:
            found[index] = row
            made = {missing[i][0] for i in found}
            rows = [row for row in earlier if cells.key(row) not in made] + [found[i] for i in sorted(found)]
            save_rows(out, rows, program)
            after(f"{len(cells.args) - len(missing) + len(found)}/{len(cells.args)}", row, rows)
    return rows


def _run_cell(run: Callable[..., Row], spec: Spec) -> Row:
    return run(*spec[1])


@dataclass(frozen=True, slots=True)
class _Rows:
    """The content of a bench's file."""

    format: str
    rows: tuple[dict[str, Any], ...]


def load_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file; none if there is no file.

    Raises:
        DatasetError: It holds something else.
    """
    if not path.exists():
        return []
    found = read_json(path, _Rows, "rows of a bench", "name another file")
    if found.format != FORMAT:
        raise DatasetError(f"{path} has format {shown(found.format)}, not {FORMAT!r}; name another file")
    return list(found.rows)


def save_rows(path: Path, rows: Sequence[Mapping[str, Any]], program: str = "deal-hw") -> None:
    """Write rows with their machine and command, as JSON and as CSV."""
    write_rows(path, rows, program)
    names = sorted({k for row in rows for k, v in row.items() if not isinstance(v, dict | list)})
    with path.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], program: str = "deal-hw") -> None:
    """Write rows with their machine and command, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": FORMAT, **describe_call(program), "rows": list(rows)})


def describe_call(program: str) -> dict[str, Any]:
    """Return the machine and the command of measurements; file names without folders, which are private."""
    words = (re.sub(r"[^\s=,]*/", "", word) for word in sys.argv[1:])
    return {"machine": describe_machine(), "argv": [program, *words]}


def describe_machine() -> dict[str, Any]:
    """Return the facts about the machine that a reader of measurements needs."""
    return {
        "platform": platform.platform(),
        "processors": len(os.sched_getaffinity(0)),
        "load": list(os.getloadavg()),
        "versions": versions(),
        "git_commit": git_commit(),
    }


def per_parameter(result: CalibrationResult, theta: FloatArray) -> dict[str, dict[str, float]]:
    """Return truth, (K,), estimate and interval of each parameter, by name."""
    return {
        name: {"truth": float(true), "estimate": float(found), "low": float(low), "high": float(high)}
        for name, true, found, (low, high) in zip(
            result.space.names, theta, result.estimate, result.interval, strict=True
        )
    }
