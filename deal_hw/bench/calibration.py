"""The calibration benches: methods against hidden truths, one row per cell.

- fixed-range: each seed's truth is off the middle of a fixed range, whose midpoint is the wrong nominal
model. - mismatch: the same on robots with effects that no simulator here has (profile ``realistic``).
- paper: ranges [theta / xi, xi theta] on a linear scale around the truth itself, as in DEAL's tables. A
  search that ignores the data and returns the midpoint of the log range has an error of 0 there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from deal_hw.bench.figures import draw
from deal_hw.bench.loop import calibration_row
from deal_hw.bench.rows import Cells, RowTable, noted_in
from deal_hw.bench.settings import FixedRange, Mismatch
from deal_hw.bench.tables import line, print_summary
from deal_hw.bench.tasks import check_tasks, make_case

if TYPE_CHECKING:
    from deal_hw.sim.engine.gpu import EngineName

PAPER_NOTE = "the truth is the nominal model: its values, kept without any recording, have an error of 0 here"
KEY = (
    "task",
    "space",
    "profile",
    "demonstration",
    "demonstration_s",
    "checkpoint",
    "method",
    "refined",
    "range_ratio",
    "seed",
    "engine",
)
"""Fields that identify a cell."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One calibration of one robot by one method.

    Attributes:
        protocol: Name of the bench: the relation of truth and range.
        task: Name of the task.
        space: Name of the parameter set; "" for the task's default.
        profile: Profile of the robot.
        demonstration: "excite" or "policy".
        demonstration_s: Its length [s].
        checkpoint: Name of the policy that demonstrates; "" for the shipped one.
        policy: Its file.
        method: Name of the method.
        refined: Whether the refinement follows.
        range_ratio: Ratio of the search range.
        seed: Seed of everything.
        engine: What simulates the population of a search; "" for mujoco.
    """

    protocol: str
    task: str
    space: str
    profile: str
    demonstration: str
    demonstration_s: float
    checkpoint: str
    policy: Path | None
    method: str
    refined: bool
    range_ratio: float
    seed: int
    engine: EngineName | Literal[""]

    @property
    def key(self) -> tuple[Any, ...]:
        """The cell's identity in a file of rows."""
        return tuple(getattr(self, name) for name in KEY)


def make_cells(settings: FixedRange | Mismatch) -> list[Cell]:
    """Return the cells of a bench, seed by seed, so that a stopped bench has complete seeds.

    Raises:
        UnknownNameError: There is no such task or method.
    """
    from deal_hw.calib.pipeline.methods import check_method, is_default

    check_tasks(settings.task)
    for method in settings.methods:
        check_method(method)
    return [
        Cell(
            protocol=settings.name,
            task=task,
            space=settings.space,
            profile=settings.profile,
            demonstration=settings.demonstration,
            demonstration_s=settings.demonstration_seconds,
            checkpoint="" if policy is None else policy.stem,
            policy=policy,
            method=method,
            refined=settings.refine_all or is_default(method),
            range_ratio=range_ratio,
            seed=seed,
            engine=settings.engine_of(method),
        )
        for task, range_ratio, policy, seed, method in itertools.product(
            settings.task,
            settings.range_ratio,
            settings.checkpoint or (None,),
            settings.seeds,
            settings.methods,
        )
    ]


def table(settings: FixedRange | Mismatch) -> RowTable:
    """Return the bench: its cells by :func:`run_cell`.

    Raises:
        UnknownNameError: There is no such task or method.
    """
    run = partial(
        run_cell,
        population=settings.population,
        generations=settings.generations,
        threads=settings.cell_threads,
    )
    args = [(cell.key, (cell,)) for cell in make_cells(settings)]
    cells = Cells(names=KEY, run=run, args=args, tasks=settings.tasks(), bench=settings.name)
    return RowTable(cells=cells, line=line, summary=print_summary, draw=draw)


def run_cell(cell: Cell, *, population: int | None, generations: int, threads: int | None) -> dict[str, Any]:
    """Run one cell; an error goes into the row, so that the other cells still run.

    Without a population each method has its default.
    """
    from deal_hw.calib.pipeline.methods import usual_budget

    row: dict[str, Any] = {"bench": cell.protocol}
    row |= {name: getattr(cell, name) for name in KEY} | {"error": ""}
    if cell.protocol == "paper":
        row["note"] = PAPER_NOTE
    budget = usual_budget(cell.method, population, generations, refine=cell.refined)
    with noted_in(row):
        case = make_case(
            cell.task,
            cell.profile,
            cell.seed,
            cell.range_ratio,
            cell.space,
            centred=cell.protocol == "paper",
            by_policy=cell.demonstration == "policy",
            checkpoint=cell.policy,
            seconds=cell.demonstration_s,
        )
        part, _ = calibration_row(case, cell.method, budget, threads, cell.engine or "mujoco")
        row |= part
    return row
