"""Does memory stay flat over generations? Resident memory of each search, generation by generation.

Each method runs in a process of its own on a short cart-pole recording. A search that ends before the wanted
number of generations is run again on the same problem with another seed, so that what a run leaves behind
shows. The growth is that of a straight line through the second half of the generations: by then libraries are
loaded and buffers have their size.

    python tools/measure_memory.py --out docs/measured/memory.json
"""

from __future__ import annotations

import argparse
import gc
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calib.methods import make_method
from deal_hw.calib.problem import Problem
from deal_hw.calibration import Budget, Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.episode import align
from deal_hw.sim.model import load_model
from deal_hw.testing.simulated_episode import simulated_episode

METHODS = (
    "weki", "deal", "deal-paper", "easi", "bo", "cma", "gauss-newton", "ekf", "least-squares",
    "least-squares-multistart", "random",
)  # fmt: skip
"""Each search once; the variants of deal-paper share its code."""

FLAT_MIB = 1.0
"""Growth in a hundred generations below this is the allocator's, not the search's [MiB]."""

MIB = 1024.0**2


class Enough(Exception):  # noqa: N818
    """The wanted number of generations is reached."""


def watch(method: str, generations: int, population: int, seconds: float) -> dict[str, Any]:
    """Run a search for so many generations and return its resident memory after each.

    Args:
        method: Name of the method.
        generations: Generations, over as many runs as it takes.
        population: Members.
        seconds: Length of the recording [s].
    """
    import psutil

    space = k9_space().with_ratio(5.0)
    theta = space.unnormalize(np.random.default_rng(1).uniform(0.3, 0.7, len(space)))
    made = simulated_episode(DESCRIPTION, space, theta, seconds=seconds, latency_ticks=5, sensor=True, seed=1)
    problem = Problem(load_model(DESCRIPTION), space, [align(made, DESCRIPTION)], threads=1)
    process, rss, runs = psutil.Process(), [], 0

    def note(progress: Progress) -> None:
        gc.collect()
        rss.append(process.memory_info().rss / MIB)
        if len(rss) >= generations:
            raise Enough

    try:
        while True:
            runs += 1
            budget = Budget(population=population, generations=generations, polish=False)
            make_method(method).run(problem, budget, np.random.default_rng(runs), note)
    except Enough:
        pass
    return {"method": method, "runs": runs, "rss_mib": [round(value, 2) for value in rss], **summary(rss)}


def summary(rss_mib: list[float]) -> dict[str, Any]:
    """Return what a series of resident memory says, one value a generation [MiB]."""
    late = np.array(rss_mib[len(rss_mib) // 2 :])
    slope = float(np.polyfit(np.arange(len(late)), late, 1)[0]) if len(late) > 1 else 0.0
    return {
        "generations": len(rss_mib),
        "first_mib": round(rss_mib[0], 1),
        "last_mib": round(rss_mib[-1], 1),
        "growth_mib_per_100_generations": round(100 * slope, 3),
        "flat": 100 * slope < FLAT_MIB,
    }


def main() -> int:
    """Measure and write one JSON file; return 1 where a search grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--generations", type=int, default=200)
    parser.add_argument("--population", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=1.2, help="length of the recording")
    parser.add_argument("--out", type=Path, default=None, help="file to write; printed only without it")
    parser.add_argument("--one", action="store_true", help="measure in this process and print JSON")
    config = parser.parse_args()
    if config.one:
        row = watch(config.methods[0], config.generations, config.population, config.seconds)
        print(json.dumps(row))
        return 0
    sizes = [f"--{key}={getattr(config, key)}" for key in ("generations", "population", "seconds")]
    rows = []
    for method in config.methods:
        # A process of its own: resident memory that another method left would hide growth.
        words = [sys.executable, __file__, "--one", "--methods", method, *sizes]
        done = subprocess.run(words, check=True, capture_output=True, text=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print({key: value for key, value in rows[-1].items() if key != "rss_mib"}, flush=True)
        if config.out is not None:
            settings = {key: getattr(config, key) for key in ("generations", "population", "seconds")}
            text = json.dumps({"settings": settings, "rows": rows}, indent=1) + "\n"
            config.out.write_text(text, encoding="utf-8")
    return 0 if all(row["flat"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
