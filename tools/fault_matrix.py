#!/usr/bin/env python3
"""The matrix of faults: every robot with a driver, every fault, every phase of a run, in virtual time.

python tools/fault_matrix.py --out fault_matrix.json
python tools/fault_matrix.py --robots so101,go2 --faults "reading frozen" --out part.json
python tools/fault_matrix.py --table fault_matrix.json

The fault tables live with the robots (`drivers/*/fault_rows.py`), and `deal_hw/testing/fault_run.py` runs a
cell. The emulated device judges it: the time until its drives follow no command any more, how fast a joint is
driven after the fault's end, and how fast the next run begins. A cell is as expected if all of this is within
the table's limits. Rows that a file holds without an error are not run again.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Final

from measuring import Row, Rows, markdown, parser, read_rows
from virtual_fleet import FleetRobot, fleet

from deal_hw.testing.fault_rows import FAULTS, PHASES, Lacks
from deal_hw.testing.fault_run import complaints, driven_s, run_fault

NAMES: Final = ("robot", "fault", "phase")
"""What identifies a row."""


def measure(one: FleetRobot, fault: str, phase: str) -> Row:
    """Run one fault in one phase, and return its row; of one that the robot lacks, the reason alone."""
    cell = one.faults.combinations()[fault, phase]
    row: Row = {"robot": one.name, "fault": fault, "phase": phase, "lacks": "", "error": ""}
    if isinstance(cell, Lacks):
        return {**row, "lacks": cell.why}
    found = run_fault(one.fault_rig(), fault, phase)
    wrong = complaints(found, phase, cell, one.faults)
    return {
        **row,
        "expected": cell.end,
        "since": cell.since,
        "within_s": cell.within_s,
        "outcome": found.outcome,
        "reason": found.reason,
        "driven_s": round(driven_s(found, cell), 3),
        "confirmed": found.confirmed,
        "speed_after_return": round(found.after_return, 2),
        "next_speed": round(found.next_speed, 2),
        "error": "; ".join(wrong),
    }


def counts(rows: Sequence[Row]) -> str:
    """Return how many cells are as expected, by robot and phase, and how many the robot lacks."""
    found: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    lacking: dict[str, int] = defaultdict(int)
    for row in rows:
        if row["lacks"]:
            lacking[row["robot"]] += 1
        else:
            found[row["robot"]][row["phase"]].append(row)
    lines = [
        (
            robot,
            *(_right(mine[phase]) for phase in PHASES),
            _right([row for cells in mine.values() for row in cells]),
            lacking[robot],
        )
        for robot, mine in found.items()
    ]
    every = [row for row in rows if not row["lacks"]]
    ends = [_right([row for row in every if row["phase"] == phase]) for phase in PHASES]
    lines.append(("all", *ends, _right(every), sum(lacking.values())))
    return markdown(("robot", *PHASES, "all", "lacks"), lines)


def _right(rows: Sequence[Row]) -> str:
    return f"{sum(not row['error'] for row in rows)} of {len(rows)}" if rows else ""


def times(rows: Sequence[Row]) -> str:
    """Return the longest time for which drives followed commands, by fault and phase, over all robots [s].

    A time counts from the fault; those that count from the fault's end or from the run's first command are
    given beside it. Cells in which the robot may go on, holds or was never touched have no time.
    """
    worst: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for row in rows:
        if not row["lacks"] and row["expected"].startswith("passive"):
            cell = worst[row["fault"], row["phase"]]
            cell[row["since"]] = max(cell.get(row["since"], 0.0), row["driven_s"])
    lines = [
        (fault, *(_times(worst.get((fault, phase), {})) for phase in PHASES))
        for fault in FAULTS
        if any((fault, phase) in worst for phase in PHASES)
    ]
    return markdown(("fault", *PHASES), lines)


def _times(cell: dict[str, float]) -> str:
    behind = {"fault": "", "return": " after its end", "first command": " after the first command"}
    return ", ".join(f"{cell[since]:.2f}{behind[since]}" for since in behind if since in cell)


def wrong(rows: Sequence[Row]) -> str:
    """Return the cells that are not as expected, a line each."""
    return "\n".join(
        f"{row['robot']}, {row['fault']}, {row['phase']}: {row['error']}" for row in rows if row["error"]
    )


def show(rows: Sequence[Row]) -> None:
    """Print both tables, and what is wrong."""
    print(counts(rows), times(rows), wrong(rows), sep="\n\n")


def _chosen(text: str | None, every: Sequence[str]) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else tuple(every)


def main() -> int:
    """Measure, or print the tables of a file; 1: something is not as expected."""
    made = parser(__doc__, table=True)
    made.add_argument("--robots", help="names such as so101,go2; by default all")
    made.add_argument("--faults", help="names such as 'reading frozen,foreign writer'; by default all")
    made.add_argument("--phases", help="names such as running,homing; by default all")
    args = made.parse_args()
    if args.table is not None:
        rows = read_rows(args.table)
    else:
        robots, kept = fleet(), Rows(__file__, args.out, NAMES)
        chosen: list[tuple[Any, ...]] = [
            (name, fault, phase)
            for name in _chosen(args.robots, tuple(robots))
            for fault in _chosen(args.faults, FAULTS)
            for phase in _chosen(args.phases, PHASES)
        ]
        for name, fault, phase in chosen:
            if not kept.done(name, fault, phase):
                kept.add(measure(robots[name], fault, phase), "")
        rows = kept.rows
    show(rows)
    return int(any(row["error"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
