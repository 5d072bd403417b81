"""Wall clock of the searches over the wall clock of the same number of steps in the bare engine.

Both sides run in one process, alternating, with the same number of threads; medians are reported. The paper's
budget is the default: 50 generations x 200 members x 200 ticks, 4 substeps of 5 ms, a critic of 256-256 with
20 updates of 1024.

    python tools/measure_calibration_speed.py --out speed.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import describe_call
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.pipeline.methods import CLOSED_LOOP_METHODS, make_method, usual_population
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.sim.engine.batch import bare_steps_per_second
from deal_hw.sim.engine.model import load_model

PAPER_STEP_S = 0.005
BARE_STEPS = 4000


def processor() -> str:
    """Return the processor's name, which the seconds depend on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def measure(method: str, budget: Budget, threads: int, repeats: int, seed: int) -> dict[str, Any]:
    """Time a search and, before and after each run, the bare engine with the same model and members."""
    paper = method in CLOSED_LOOP_METHODS
    demonstration = make_case("cartpole", "ideal", seed, 5.0, by_policy=paper)
    robot = load_model(DESCRIPTION, step_s=PAPER_STEP_S if paper else None)
    rows = []
    for _ in range(repeats):
        before = bare_steps_per_second(robot, budget.population, BARE_STEPS, threads)
        problem = Problem(
            robot, demonstration.space, [demonstration.fit], threads=threads, policy=demonstration.policy
        )
        start = time.perf_counter()
        result = make_method(method).run(problem, budget, np.random.default_rng(seed))
        seconds = time.perf_counter() - start
        after = bare_steps_per_second(robot, budget.population, BARE_STEPS, threads)
        bare = result.steps / statistics.mean((before, after))
        rows.append(
            {"seconds": seconds, "steps": result.steps, "bare_seconds": bare, "ratio": seconds / bare}
        )
        print(
            f"{method:12s} {seconds:7.1f} s  {result.steps:.2e} steps  bare {bare:6.1f} s  "
            f"ratio {rows[-1]['ratio']:.2f}"
        )
    return {
        "method": method,
        "step_s": robot.step_s,
        "population": budget.population,
        "generations": budget.generations,
        "threads": threads,
        "runs": rows,
        "seconds": statistics.median(r["seconds"] for r in rows),
        "ratio": statistics.median(r["ratio"] for r in rows),
    }


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--methods", default="deal-paper,deal,eki")
    parser.add_argument("--threads", type=int, default=1, help="of simulation, engine and critic alike")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--generations", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    report: dict[str, Any] = {**describe_call(f"tools/{Path(__file__).name}"), "cpu": processor(), "rows": []}
    for method in options.methods.split(","):
        budget = Budget(population=usual_population(method), generations=options.generations)
        report["rows"].append(measure(method, budget, options.threads, options.repeats, options.seed))
    report["load_after"] = os.getloadavg()
    if options.out is not None:
        options.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
