"""What `--ray` costs beside the work: cells of half a minute, in this process and in workers.

A row for each number of workers (0: this process). Cells are calibrations of a cart-pole, as of `bench
fixed-range`; with `--method default --profile realistic` they take about 50 processor seconds each. On a
machine with other work, seconds say little. So the overhead is counted in processor time: what this process
and all of Ray's spend between the first task and the last, above what the cells spend themselves. The start,
until each worker has loaded the libraries, is said apart.

.venv/bin/python tools/measure_ray.py --method default --profile realistic --workers 0,1,2 --out measured.json
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, get_args

import psutil
from measuring import Rows, add_seeds, parser

from deal_hw.bench.calibration import make_cells, run_cell
from deal_hw.bench.settings import FixedRange, Profile
from deal_hw.scale.tasks import task_map


def cell(seed: int, method: str, profile: Profile = "sensor") -> tuple[str, float]:
    """Calibrate one robot; return the row but for its time, as JSON, and the processor time [s]."""
    began = time.process_time()
    (one,) = make_cells(FixedRange(methods=(method,), profile=profile, seeds=(seed,)))
    row = run_cell(one, population=None, generations=50, threads=1)
    del row["seconds"]
    return json.dumps(row, default=repr), time.process_time() - began


def processor_s() -> float:
    """Return the processor time of this process and of those that it has started [s]."""
    here, total = psutil.Process(), 0.0
    for process in (here, *here.children(recursive=True)):
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total


def measure(
    workers: int, seeds: Sequence[int], method: str, profile: Profile
) -> tuple[dict[str, Any], list[str]]:
    """Do the cells; return the row without its overhead, and the cells' own rows."""
    began = time.perf_counter()
    with task_map(f"local:{workers}" if workers else None) as tasks:
        tasks.map(load, range(2 * workers))
        start_s, spent, began = time.perf_counter() - began, processor_s(), time.perf_counter()
        found = tasks.map(partial(cell, method=method, profile=profile), seeds)
        row = {
            "method": method,
            "profile": profile,
            "workers": workers,
            "cells": len(seeds),
            "start_s": start_s,
            "seconds": time.perf_counter() - began,
            "cpu_seconds": processor_s() - spent,
            "cpu_seconds_cells": sum(seconds for _, seconds in found),
        }
    return row, [text for text, _ in found]


def load(seed: int) -> None:
    """Load what a cell needs, as the first cell of a worker does."""
    import deal_hw.calib.pipeline.output_error_fits
    import deal_hw.calib.report.verdict  # noqa: F401

    cell(seed, method="midpoint")


def main() -> None:
    """Measure as the command line says; print a row for each number of workers."""
    options = parser(__doc__)
    add_seeds(options, 0, 1)
    options.add_argument(
        "--workers", default="0,1,2", help="numbers of workers; 0, this process, comes first"
    )
    options.add_argument("--method", default="local", help="method of the cells")
    options.add_argument("--profile", default="sensor", choices=get_args(Profile), help="of the robots")
    args = options.parse_args()
    rows, numbers = Rows(__file__, args.out), list[str]()
    for workers in map(int, args.workers.split(",")):
        row, found = measure(workers, args.seeds, args.method, args.profile)
        numbers = numbers or found
        row["equal"] = found == numbers
        row["overhead_percent"] = 100 * (row["cpu_seconds"] / row["cpu_seconds_cells"] - 1)
        rows.add(row)


if __name__ == "__main__":
    main()
