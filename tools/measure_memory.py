"""Measure the growth of each method's memory over its generations, or over repeated runs.

Each method runs in a process of its own on a short cart-pole recording. Memory of a search is measured after
every generation. A search that ends early is run again on the same problem with another seed, so that memory
left by a run shows. A method without generations, or with its own choice of steps, is run repeatedly and
measured after every run.

There are two figures. Resident memory is the process's memory as the system counts it. Held memory is the
memory that malloc has handed out (glibc only), in Python, NumPy, torch and MuJoCo. It excludes freed memory
and includes addresses that were never written to. The measurement neither collects garbage nor trims memory.
The first half of the values is warm-up: by its end libraries are loaded and buffers have their size. The
slope of a line through the second half is the growth.

    python tools/measure_memory.py --out docs/measured/memory.json
"""

from __future__ import annotations

import ctypes
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from fakes.recorded_commands import RecordedCommands
from fakes.simulated_episode import simulated_episode
from measuring import head, parser

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calibration import Budget, Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align

Unit = Literal["generation", "run"]

REFINED = "default, refined"
"""Settings of `deal-hw calibrate` without options."""

SEARCHES = (
    "eki",
    "deal",
    "deal-paper",
    "deal-paper-literal",
    "deal-paper-literal-fn",
    "deal-paper-literal-pn",
    "deal-paper-literal-flat",
    "deal-paper-fn",
    "deal-paper-pn",
    "deal-paper-flat",
    "deal-paper-replay",
    "easi-log",
    "bo-critic",
    "easi",
    "bo",
    "cma",
    "gauss-newton",
    "ekf",
    "random",
)
"""Methods with generations; a generation of `ekf` is a pass along the recording."""

WHOLES = ("least-squares", "least-squares-multistart", "mujoco-sysid", "local", "output-error", REFINED)
"""Methods without; `midpoint` and `nominal`, which only draw once, are not measured."""

LONGER = {"bo": 2, "gauss-newton": 4}
"""Factor on the generations: until the Gaussian process has all its points (49 generations), and until
`gauss-newton` has restarted (62 draws, some 25 refinements)."""

LEAST_SECONDS = {"local": 1.6, "output-error": 1.6, REFINED: 1.6}
"""Length of recordings for methods that refuse shorter ones [s]."""

RUN_GENERATIONS = 5
"""Generations that count as one run of a method without generations."""

FLAT_KIB: Mapping[Unit, float] = {"generation": 10.0, "run": 10.0 * RUN_GENERATIONS}
"""Growth below this counts as chance: 1 MiB in a hundred generations [KiB]."""

KIB, MIB = 1024.0, 1024.0**2


class Enough(Exception):  # noqa: N818
    """The requested number of values is complete."""


class MallocInfo(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        )
    ]


def heap_reader() -> Callable[[], float] | None:
    """Return a function for the memory that malloc has handed out [MiB]; None if the C library has none."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None) if sys.platform == "linux" else None
    if ask is None:
        return None
    ask.restype = MallocInfo

    def read() -> float:
        info = ask()
        return float(info.uordblks + info.hblkhd) / MIB

    return read


class Series:
    """Memory after each generation or run."""

    def __init__(self, wanted: int) -> None:
        import psutil

        self._process, self._heap, self._wanted = psutil.Process(), heap_reader(), wanted
        self.rss: list[float] = []
        self.held: list[float] = []

    def take(self) -> None:
        """Take a value.

        Raises:
            Enough: It was the last.
        """
        self.rss.append(self._process.memory_info().rss / MIB)
        if self._heap is not None:
            self.held.append(self._heap())
        if len(self.rss) >= self._wanted:
            raise Enough

    def note(self, progress: Progress) -> None:
        """Take a value after a generation of the search."""
        if progress.stage == "search":
            self.take()


def make_problem(seconds: float) -> Problem:
    """Return a problem with a recording of this length."""
    space = k9_space().with_ratio(5.0)
    theta = space.unnormalize(np.random.default_rng(1).uniform(0.3, 0.7, len(space)))
    made = simulated_episode(DESCRIPTION, space, theta, seconds=seconds, latency_ticks=5, sensor=True, seed=1)
    episode = align(made, DESCRIPTION)
    policy = RecordedCommands.of(episode.target, 20)
    return Problem(load_model(DESCRIPTION), space, [episode], threads=1, policy=policy)


def watch(method: str, generations: int, population: int, seconds: float) -> dict[str, Any]:
    """Run a method often enough and return its memory over generations or runs.

    Args:
        method: Name of the method.
        generations: Generations that are wanted.
        population: Members.
        seconds: Length of the recording [s].
    """
    refine = method == REFINED
    unit: Unit = "run" if method in WHOLES else "generation"
    generations *= LONGER.get(method, 1)
    wanted = generations if unit == "generation" else max(generations // RUN_GENERATIONS, 4)
    each = generations if unit == "generation" else RUN_GENERATIONS
    series = Series(wanted)
    problem, runs = make_problem(max(seconds, LEAST_SECONDS.get(method, 0.0))), 0
    budget = Budget(population=population, generations=each, refine=refine)
    try:
        while True:
            runs += 1
            made = make_method("default" if refine else method, refine=refine)
            note = series.note if unit == "generation" else None
            made.run(problem, budget, np.random.default_rng(runs), note)
            if unit == "run":
                series.take()
    except Enough:
        pass
    return {"method": method, "unit": unit, "runs": runs, **summary(series.rss, series.held, FLAT_KIB[unit])}


def slope_kib(values: Sequence[float]) -> float:
    """Return the growth of a straight line through the second half of values [MiB], in KiB a value."""
    late = np.asarray(values[len(values) // 2 :])
    return float(np.polyfit(np.arange(len(late)), late, 1)[0]) * KIB if len(late) > 1 else 0.0


def verdict(rss: float, held: float | None, most: float) -> str:
    """Return a text on slopes; those below the given limit are chance [KiB a value]."""
    if rss < most and (held is None or held < most):
        return "flat"
    if held is not None and held < most:
        return "held memory does not grow; malloc keeps freed memory"
    return "grows"


def summary(rss: Sequence[float], held: Sequence[float], most_kib: float) -> dict[str, Any]:
    """Return statistics of two series of memory [MiB]."""
    grown = slope_kib(held) if held else None
    return {
        "count": len(rss),
        "warm_up": len(rss) // 2,
        "first_mib": round(rss[0], 1),
        "last_mib": round(rss[-1], 1),
        "rss_kib_each": round(slope_kib(rss), 2),
        "held_kib_each": None if grown is None else round(grown, 2),
        "verdict": verdict(slope_kib(rss), grown, most_kib),
        "rss_mib": [round(value, 2) for value in rss],
        "held_mib": [round(value, 2) for value in held],
    }


def measured(method: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Measure a method in a process of its own, because memory of another method would hide growth."""
    words = [sys.executable, __file__, "--one", "--methods", method]
    words += [f"--{key}={value}" for key, value in settings.items()]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def write(path: Path, settings: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write settings and rows, a line each; rows of other methods stay if the settings are the same."""
    settings = {**settings, "flat_kib": FLAT_KIB, "libc": " ".join(platform.libc_ver())}
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    kept = before["rows"] if before.get("settings") == settings else []
    found = {row["method"]: row for row in (*kept, *rows)}
    lines = ",\n".join(json.dumps(found[m]) for m in (*SEARCHES, *WHOLES) if m in found)
    first = json.dumps({**head(__file__), "settings": settings})
    path.write_text(f'{first[:-1]},\n"rows": [\n{lines}\n]}}\n', encoding="utf-8")


def main() -> int:
    """Measure and write one JSON file; return 1 if a method's memory grows."""
    options = parser(__doc__)
    options.add_argument("--methods", nargs="+", default=[*SEARCHES, *WHOLES])
    options.add_argument("--generations", type=int, default=60)
    options.add_argument("--population", type=int, default=8)
    options.add_argument("--seconds", type=float, default=0.6, help="length of the recording")
    options.add_argument("--one", action="store_true", help="measure in this process and print JSON")
    config = options.parse_args()
    settings = {key: getattr(config, key) for key in ("generations", "population", "seconds")}
    if config.one:
        print(json.dumps(watch(config.methods[0], **settings)))
        return 0
    rows = []
    for method in config.methods:
        rows.append(measured(method, settings))
        print({key: value for key, value in rows[-1].items() if not key.endswith("_mib")}, flush=True)
        if config.out is not None:
            write(config.out, settings, rows)
    return int(any(row["verdict"] == "grows" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
