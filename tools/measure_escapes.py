#!/usr/bin/env python3
"""What leads a fit out of a wrong minimum: the search, or restarts from what was expected?

    python tools/measure_escapes.py --kinds cartpole,arm --seeds 100-139 --out escapes.json
    python tools/measure_escapes.py --table escapes.json

The robots are those of `ordinary_robots.py`; the owner's gains, dampings, frictions and armatures are off by
the square of the usual factors (--errors 2). Where the local fit from these values is at the noise, nothing
is left to compare. Elsewhere two ways follow, each with the physics steps that the first takes:

    search    the brief search of the default (DEAL), a refinement from its estimate, and refinements from up
              to 4 members of its population
    restarts  refinements from points drawn from the priors, until the same number of steps is used

A row has the chi2 of the local fit, the lowest of each way, and the steps. A fit is out at a chi2 below 1.3.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import ordinary_robots
from measuring import Row, Rows, add_seeds, markdown, parser, read_rows

from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2
from deal_hw.calib.fit.refinement import from_start, local_fit
from deal_hw.calib.pipeline.methods import DEFAULT_SEARCH, make_method
from deal_hw.calibration import Budget
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

MEMBERS = 4


def make_problem(kind: str, seed: int, errors: float, folder: Path) -> Problem:
    """Return the problem of a robot whose owner's errors have an exponent."""
    ordinary_robots.write_case(kind, seed, folder, errors=errors)
    settings = FilesSettings(
        model=folder / "nominal.xml",
        data=(folder / "fit1.csv", folder / "fit2.csv"),
        holdout_part=0.0,
        columns=folder / "columns.yaml",
        threads=1,
    )
    work = calibration_input(settings)
    return Problem(
        work.robot,
        work.space,
        work.episodes,
        threads=1,
        latency_range_s=settings.latency_range,
        guessed=work.guessed,
    )


def lowest(problem: Problem, starts: Iterator[Member], steps: float) -> tuple[float, int]:
    """Return the lowest chi2 of refinements, and their number, until one explains or the steps are used."""
    best, count, before = np.inf, 0, problem.steps
    for start in starts:
        count += 1
        best = min(best, from_start(problem, start).chi2)
        if best < MISMATCH_CHI2 or problem.steps - before >= steps:
            break
    return float(best), count


def by_search(problem: Problem, rng: np.random.Generator) -> Iterator[Member]:
    """Yield the estimate of a brief search, then members of its last population."""
    budget = Budget(brief=True)
    found = make_method(DEFAULT_SEARCH).run(problem, budget, rng)
    yield found.estimate, found.latency_s
    population: FloatArray | None = found.population
    if population is not None:
        for theta in rng.permutation(population)[:MEMBERS]:
            yield theta, found.latency_s


def by_restarts(problem: Problem, rng: np.random.Generator) -> Iterator[Member]:
    """Yield points drawn from the priors, cut off at the ranges."""
    space = problem.space
    mean, std = space.prior
    std = np.where(np.isfinite(std), std, space.width / np.sqrt(12))
    while True:
        drawn = space.from_scale(space.to_scale(mean) + std * rng.standard_normal(len(space)))
        yield np.clip(drawn, space.low, space.high), problem.first_latency_s


def measure(kind: str, seed: int, errors: float) -> Row:
    """Fit one robot and, where that does not explain it, compare both ways."""
    with tempfile.TemporaryDirectory() as name:
        problem = make_problem(kind, seed, errors, Path(name))
        local = local_fit(problem)
        row: Row = {"local": np.inf if local is None else local.chi2, "local_steps": problem.steps}
        if row["local"] < MISMATCH_CHI2:
            return row
        before = problem.steps
        row["search"], row["search_fits"] = lowest(
            problem, by_search(problem, np.random.default_rng(seed)), np.inf
        )
        row["steps"] = problem.steps - before
        row["restarts"], row["restart_fits"] = lowest(
            problem, by_restarts(problem, np.random.default_rng(seed)), row["steps"]
        )
        row["restart_steps"] = problem.steps - before - row["steps"]
        return row


def table(rows: Sequence[Row]) -> str:
    """Return one line for each kind."""
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        of = [row for row in rows if row["kind"] == kind and not row["error"]]
        stuck = [row for row in of if "steps" in row]
        out = [sum(row[way] < MISMATCH_CHI2 for row in stuck) for way in ("search", "restarts")]
        steps = [f"{np.median([r[n] for r in stuck]) / 1e6:.1f}" for n in ("steps", "restart_steps") if stuck]
        lines.append((kind, f"{len(stuck)} of {len(of)}", *map(str, out), *(steps or ("", ""))))
    heads = ("robot", "local fit above the noise", "out by search", "by restarts", "steps [M]", "steps [M]")
    return markdown(heads, lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure kinds and seeds."""
    made = parser(__doc__, table=True)
    made.add_argument("--kinds", default="cartpole", help=f"of {','.join(ordinary_robots.KINDS)}")
    made.add_argument("--errors", type=float, default=2.0, help="exponent of the usual factors")
    add_seeds(made)
    options = made.parse_args(arguments)
    if options.table is not None:
        print(table(read_rows(options.table)))
        return 0
    rows = Rows(__file__, options.out, names=("kind", "seed", "errors"))
    for kind in options.kinds.split(","):
        for seed in options.seeds:
            rows.measured(
                {"kind": kind, "seed": seed, "errors": options.errors},
                f"{kind} {seed}",
                partial(measure, kind, seed, options.errors),
                lambda row: ", ".join(f"{k} {v:.3g}" for k, v in row.items() if isinstance(v, float)),
            )
    print(table(rows.rows))
    return int(any(row["error"] for row in rows.rows))


if __name__ == "__main__":
    sys.exit(main())
