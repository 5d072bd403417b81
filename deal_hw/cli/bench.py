"""``deal-hw bench``: measures calibration and the whole loop, as JSON rows, a CSV and a figure."""

from __future__ import annotations

import importlib
import json
import sys
from typing import TYPE_CHECKING

from deal_hw.bench.settings import BENCHES, Bench
from deal_hw.cli.json_output import only_document
from deal_hw.cli.piped import PipedProgress
from deal_hw.workflows.kinds import InputKind, Kinds

if TYPE_CHECKING:
    from deal_hw.bench.rows import Row, RowTable

KINDS = Kinds(
    noun="bench",
    table=lambda: {
        name: InputKind(settings, example=" ".join(f"{name} {settings.example} --out {name}.json".split()))
        for name, settings in BENCHES.items()
    },
)


def bench(settings: Bench) -> int:
    """Run what is not done yet, writing the files after each row; return 1 if any row failed."""
    with only_document(settings.json) as write:
        code = _run(settings)
        if settings.json:
            write(json.loads(settings.file.read_text(encoding="utf-8")))
    return code


def _run(settings: Bench) -> int:
    module, _, function = settings.work.partition(":")
    made: int | RowTable = getattr(importlib.import_module(module), function)(settings)
    return made if isinstance(made, int) else _run_table(settings, made)


def _run_table(settings: Bench, table: RowTable) -> int:
    from deal_hw.bench.rows import run_cells

    out = settings.file
    files = (out, out.with_suffix(".csv"), figure := out.with_suffix(".png"))

    def after(place: str, row: Row, rows: list[Row]) -> None:
        good = [row for row in rows if not row["error"]]
        if table.draw is not None and good:
            table.draw(figure, good)
        piped.at(f"{place} rows done")
        if not settings.quiet:
            print(f"{place} {table.line(row)}", flush=True)

    with PipedProgress(f"bench {settings.name}", settings.quiet or sys.stderr.isatty()) as piped:
        rows = run_cells(table.cells, out, after)
    if not settings.quiet:
        table.summary([row for row in rows if not row["error"]])
        print("written: " + ", ".join(str(path) for path in files if path.exists()))
    return 1 if any(row["error"] for row in rows) else 0
