"""``deal-hw bench``: how well calibration and the loop do, as JSON rows, a CSV and a figure."""

from __future__ import annotations

import csv
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import tyro

from deal_hw.calibration import Budget
from deal_hw.cli.bench_go2_transport import TransportBench
from deal_hw.cli.calibrate_model import Recordings
from deal_hw.cli.options import Range, Ratio, Threads, check_ranges, given, refuse
from deal_hw.data.files import write_json
from deal_hw.data.run_folder import git_commit, versions
from deal_hw.errors import ConfigurationError, DatasetError, MissingExtraError, shown
from deal_hw.reading import read_json

FORMAT = "deal_hw.bench/1"
MOST_SEEDS = 10_000
Seeds = Range(0, 2**32 - 1 - MOST_SEEDS)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure how well calibration and the loop do; a bench that was stopped goes on where it was."""

    bench: tyro.conf.Positional[
        Literal["loop", "honest", "mismatch", "paper", "real", "verdict", "go2-codec", "go2-transport"]
    ]
    """loop: collect, calibrate, train and deploy on emulated cart-poles whose truth only the bench knows.
    honest: calibrate off-centre truths in a fixed range. mismatch: the same on robots that do what no
    simulator here does. paper: DEAL's protocol, whose target is the centre of the range. real: recordings
    of a real robot (--model, --data), judged on held-out motion. verdict: robots in plain MuJoCo with and
    without deliberate faults: is a right model called right, and a wrong one wrong? go2-codec: what the
    Go2's messages cost to write and read. go2-transport: how regular 500 commands and states a second are
    over a wire."""

    recordings: tyro.conf.OmitArgPrefixes[Recordings] = field(default_factory=Recordings)

    holdout: tuple[Path, ...] = ()
    """real: recordings that only judge; by default the last part of each."""

    heldout_window: Annotated[float, Range(1e-3, 600, "s")] = 5.0
    """real: held-out predictions restart this often [s]."""

    residual_std: tuple[str, ...] = ()
    """real: what a prediction may be off, as for `deal-hw calibrate`; by default the residual of a first
    fit to the recordings that are fitted."""

    link: tyro.conf.OmitArgPrefixes[TransportBench] = field(default_factory=TransportBench)

    task: str = "cartpole"
    """Tasks, comma separated: cartpole, ant, go2 (loop: the cart-pole only)."""

    space: str = ""
    """Parameter set of the task; its default where nothing is named."""

    profile: Literal["ideal", "sensor", "realistic"] = "sensor"
    """Profile of the emulated robots."""

    seeds: str = "0,1"
    """Seeds, comma separated; ranges as 1000-1009. 0-99 are for tuning, 1000 and up for reporting."""

    methods: str = ""
    """Methods, comma separated; by default the default with training, and each search without polish."""

    xi: str = "5"
    """Ratios of the search range, comma separated (loop: one)."""

    polish_all: bool = False
    """Polish every method; by default only `default` is."""

    demonstration: Literal["excite", "policy"] = "excite"
    """How ant and Go2 are demonstrated: by motions that excite, or by their shipped policies."""

    population: Annotated[int, Range(2, 100_000)] = 100
    """Members of a search."""

    generations: Annotated[int, Range(1, 100_000)] = 50
    """Most generations of a search."""

    train: bool = True
    """Train and deploy policies with the default method."""

    out: Path | None = None
    """File of the rows, by default BENCH.json; the CSV and the figure lie beside it."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""

    quiet: bool = False
    """Print nothing but errors."""

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_seeds(self.seeds)
        parse_ratios(self.xi)
        if self.bench != "real":
            options = given(self.recordings, Recordings())
            options += given(self, Bench(bench="real"), ("holdout", "heldout_window", "residual_std"))
            refuse(options, "only `bench real` takes that")
        if self.bench != "go2-transport":
            refuse(given(self.link, TransportBench()), "only `bench go2-transport` takes that")


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as ``"0,3,1000-1009"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            ends = int(first), int(last if dash else first)
            Seeds.check("--seeds", ends)
            Range(ends[0], ends[0] + MOST_SEEDS).check("--seeds", ends[1])
            seeds += range(ends[0], ends[1] + 1)
    except ConfigurationError:
        raise
    except ValueError as err:
        raise ConfigurationError(
            f"--seeds {text!r}: give numbers and ranges, such as 0,1 or 1000-1009"
        ) from err
    if not seeds:
        raise ConfigurationError(f"--seeds {text!r} names no seed")
    return tuple(seeds)


def parse_ratios(text: str) -> tuple[float, ...]:
    """Return the ratios of a text such as ``"3,5,10"``.

    Raises:
        ConfigurationError: It is not such a text.
    """
    try:
        ratios = tuple(float(part) for part in text.split(","))
    except ValueError as err:
        raise ConfigurationError(f"--xi {text!r}: give numbers above 1, such as 5 or 3,5,10,20") from err
    Ratio.check("--xi", ratios)
    return ratios


def bench(config: Bench) -> int:
    """Run the cells that are not done yet, writing the files after each; return 1 if any cell failed."""
    if config.bench == "go2-codec":
        from deal_hw.cli.bench_go2 import bench_codec

        return bench_codec(config.out, quiet=config.quiet)
    if config.bench == "go2-transport":
        from deal_hw.cli.bench_go2_transport import bench_transport

        return bench_transport(config.link, config.out, quiet=config.quiet)
    out = config.out or Path(f"{config.bench}.json")
    rows = _load(out)
    makers = {"loop": _loop_runs, "real": _real_runs, "verdict": _verdict_runs}
    names, runs = makers.get(config.bench, _calibration_runs)(config, out)
    done = {tuple(r.get(name, "") for name in names) for r in rows if not r["error"]}
    for number, (key, run) in enumerate(runs):
        if key in done:
            continue
        row = run()
        rows = [r for r in rows if tuple(r.get(name, "") for name in names) != key] + [row]
        save(out, rows)
        if not config.quiet:
            print(f"{number + 1}/{len(runs)} {_line(row)}", flush=True)
    if not config.quiet:
        print_summary(rows)
        print(f"written: {out}, {out.with_suffix('.csv')}, {out.with_suffix('.png')}")
    return 1 if any(row["error"] for row in rows) else 0


Runs = list[tuple[tuple[Any, ...], Callable[[], dict[str, Any]]]]
"""Cells by their key, each with what runs it."""


def _methods(config: Bench, default: Sequence[str]) -> tuple[str, ...]:
    return tuple(m.strip() for m in config.methods.split(",") if m.strip()) or tuple(default)


def _loop_runs(config: Bench, out: Path) -> tuple[tuple[str, ...], Runs]:
    try:
        from deal_hw.calib.methods import check_method
        from deal_hw.cli.bench_loop import SEARCHES, loop_cells, loop_row
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "bench") from err

    methods = _methods(config, ("default", *SEARCHES))
    for method in methods:
        check_method(method)
    (xi,) = parse_ratios(config.xi)[:1]
    policies = out.parent / f"{out.stem}_policies"
    policies.mkdir(parents=True, exist_ok=True)

    def make(seed: int, method: str) -> Callable[[], dict[str, Any]]:
        return lambda: loop_row(
            config.profile, seed, method, xi, train=config.train, folder=policies, threads=config.threads
        )

    cells = loop_cells(methods, parse_seeds(config.seeds))
    return ("profile", "seed", "method", "xi"), [
        ((config.profile, seed, method, xi), make(seed, method)) for seed, method in cells
    ]


def _calibration_runs(config: Bench, out: Path) -> tuple[tuple[str, ...], Runs]:
    try:
        from deal_hw.cli.bench_calibrate import KEY, Cell, Protocol, make_cells, run_cell
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "bench") from err

    protocol = cast("Protocol", config.bench)
    cells = make_cells(
        protocol,
        [task.strip() for task in config.task.split(",")],
        "realistic" if protocol == "mismatch" else config.profile,
        _methods(config, ("default",)),
        parse_ratios(config.xi),
        parse_seeds(config.seeds),
        space=config.space,
        polish_all=config.polish_all,
        demonstration=config.demonstration,
    )

    def make(cell: Cell) -> Callable[[], dict[str, Any]]:
        return lambda: run_cell(
            cell, population=config.population, generations=config.generations, threads=config.threads
        )

    return KEY, [(cell.key, make(cell)) for cell in cells]


def _real_runs(config: Bench, out: Path) -> tuple[tuple[str, ...], Runs]:
    try:
        from deal_hw.calib.methods import check_method
        from deal_hw.cli.bench_real import KEY, METHODS, expected_std, prepare, run_cell, split_name
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "bench") from err

    methods = _methods(config, METHODS)
    for method in methods:
        check_method(method)
    (ratio,) = parse_ratios(config.xi)[:1]
    xi = None if config.recordings.parameters is not None else ratio
    task = Path(config.recordings.model or "").stem
    work = prepare(
        config.recordings, config.holdout, xi, config.residual_std, threads=config.threads, quiet=config.quiet
    )

    split = split_name(config.recordings, config.holdout)
    std = expected_std(work, config.residual_std, config.threads)

    def make(method: str, seed: int) -> Callable[[], dict[str, Any]]:
        polish = method == "default" or config.polish_all
        return lambda: run_cell(
            work, task, split, method, seed, ratio, polish=polish, std=std(method), threads=config.threads,
            budget=lambda polish: Budget(
                population=config.population, generations=config.generations, polish=polish
            ),
            window_s=config.heldout_window,
        )  # fmt: skip

    cells = [(method, seed) for seed in parse_seeds(config.seeds) for method in methods]
    keys = [(task, split, m, m == "default" or config.polish_all, ratio, s) for m, s in cells]
    return KEY, [(key, make(*cell)) for key, cell in zip(keys, cells, strict=True)]


def _verdict_runs(config: Bench, out: Path) -> tuple[tuple[str, ...], Runs]:
    try:
        from deal_hw.cli.bench_verdict import KEY, cells, run_cell
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "bench") from err

    budget = Budget(population=config.population, generations=config.generations)

    def make(kind: str, fault: str, seed: int) -> Callable[[], dict[str, Any]]:
        return lambda: run_cell(kind, fault, seed, budget=budget, threads=config.threads)

    chosen = cells(parse_seeds(config.seeds))
    return KEY, [(cell, make(*cell)) for cell in chosen]


def _line(row: Mapping[str, Any]) -> str:
    if row["bench"] == "verdict":
        from deal_hw.cli.bench_verdict import line

        return line(row)
    head = f"{' '.join(_group(row))} seed {row['seed']}"
    if row["error"]:
        return f"{head}: {row['error']}"
    if row["bench"] == "real":
        errors = (f"{name} {row[f'heldout_rmse_{name}']:.4g}" for name in ("nominal", "calibrated"))
        return f"{head}: held-out RMSE {', '.join(errors)}, {row['seconds']:.0f} s"
    text = f"{head}: error {row['error_percent']:.2f} %, log error x100 {row['log_error_x100']:.2f}"
    text += f", {row['seconds']:.0f} s"
    if "angle_error_retrained" in row:
        text += (
            f", angle error UDR {row['angle_error_udr']:.4f} retrained {row['angle_error_retrained']:.4f} "
            f"oracle {row['angle_error_oracle']:.4f} rad"
        )
    return text


@dataclass(frozen=True, slots=True)
class _Rows:
    """What the file of a bench holds."""

    format: str
    rows: tuple[dict[str, Any], ...]


def _load(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    found = read_json(path, _Rows, "rows of a bench", "name another file")
    if found.format != FORMAT:
        raise DatasetError(f"{path} has format {shown(found.format)}, not {FORMAT!r}; name another file")
    return list(found.rows)


def save(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the machine they came from, the CSV and the figure."""
    write_rows(path, rows)
    names = sorted({k for row in rows for k, v in row.items() if not isinstance(v, dict | list)})
    with path.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    _figure(path.with_suffix(".png"), [row for row in rows if not row["error"]])


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the machine they came from, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = {"format": FORMAT, "machine": describe_machine(), "argv": ["deal-hw", *sys.argv[1:]]}
    write_json(path, {**values, "rows": list(rows)})


def describe_machine() -> dict[str, Any]:
    """Return what a reader of measurements must know of the machine."""
    return {
        "platform": platform.platform(),
        "processors": len(os.sched_getaffinity(0)),
        "load": list(os.getloadavg()),
        "versions": versions(),
        "git_commit": git_commit(),
    }


def _figure(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    if not rows or rows[0]["bench"] in ("real", "verdict"):
        return
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as err:
        raise MissingExtraError("matplotlib", "bench") from err
    trained = [row for row in rows if "angle_error_retrained" in row]
    figure = Figure(figsize=(7.5, 3.6), layout="constrained")
    panels = figure.subplots(1, 1 + bool(trained), width_ratios=(3, 2)[: 1 + bool(trained)], squeeze=False)[0]
    left = panels[0]
    groups = list(dict.fromkeys(_group(row) for row in rows))
    # Only what tells the groups apart is worth a label's room.
    told = [i for i, column in enumerate(zip(*groups, strict=True)) if len(set(column)) > 1] or [-1]
    for i, group in enumerate(groups):
        # An exact result has no place on a log scale.
        values = [max(row["log_error_x100"], 1e-3) for row in rows if _group(row) == group]
        left.plot([i] * len(values), values, "o", alpha=0.6, color=f"C{i}")
    labels = [" ".join(group[i] for i in told) for group in groups]
    left.set_xticks(range(len(groups)), labels, rotation=30, ha="right")
    left.set_yscale("log")
    left.set_ylabel("100 mean |ln(p / p*)|")
    left.set_title("parameter error, one point a seed (below 1e-3: drawn at 1e-3)", fontsize=10)
    for row in trained:
        right = panels[1]
        values = [row[f"angle_error_{name}"] for name in ("udr", "retrained", "oracle")]
        right.plot(range(3), values, "o-", alpha=0.5, color="C0", linewidth=0.8)
        right.set_xticks(range(3), ["UDR", "retrained", "oracle"])
        right.set_yscale("log")
        right.set_title("pole-angle error [rad]", fontsize=10)
    figure.savefig(path, dpi=130)


def _print_real(rows: Sequence[Mapping[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="held-out RMSE in rad or m: mean over joints, all samples pooled")
    words = ("robot", "held out", "method")
    for name in (*words, "seed", "mean", "pooled", "nominal", "at a bound", "flagged", "seconds"):
        table.add_column(name, justify="left" if name in words else "right")
    for row in rows:
        numbers = (
            row.get(f"heldout_{key}") for key in ("rmse_calibrated", "pooled_calibrated", "rmse_nominal")
        )
        table.add_row(
            row["task"],
            row.get("split", ""),
            _group(row)[-1],
            str(row["seed"]),
            *("diverged" if value is None else f"{value:.4f}" for value in numbers),
            str(len(row["at_bound"])),
            str(int(row["flagged"])),
            f"{row['seconds']:.0f}",
        )
    Console(width=120).print(table)


def _group(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what a line of the summary stands for."""
    method = row["method"] + (" + polish" if row.get("polish") and row["method"] != "default" else "")
    return row.get("task", "cartpole"), row["profile"], f"{row['xi']:g}", method


def print_summary(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print median and worst by profile and method."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    good = [row for row in rows if not row["error"]]
    if good and good[0]["bench"] == "real":
        _print_real(good)
        return
    if good and good[0]["bench"] == "verdict":
        from deal_hw.cli.bench_verdict import summary

        print("\n".join(summary(good)))
        return
    table = Table(title="median over seeds (worst)")
    for name in (
        "task", "profile", "xi", "method", "seeds", "error %", "log error x100", "coverage90", "width90",
        "held-out / nominal", "latency error ms", "flagged", "seconds",
    ):  # fmt: skip
        table.add_column(name, justify="left" if name in ("task", "profile", "method") else "right")
    for group in dict.fromkeys(_group(row) for row in good):
        part = [row for row in good if _group(row) == group]

        def values(name: str, rows: Sequence[Mapping[str, Any]] = part) -> Any:
            return np.array([row[name] for row in rows], dtype=float)

        ratio = values("heldout_nrmse_calibrated") / values("heldout_nrmse_nominal")
        late = 1e3 * np.abs(values("latency_found") - values("latency_true"))
        table.add_row(
            *group,
            str(len(part)),
            *(
                f"{np.median(values(n)):.2f} ({values(n).max():.2f})"
                for n in ("error_percent", "log_error_x100")
            ),
            f"{values('coverage90').mean():.2f}",
            f"{np.median(values('width90')):.2f}",
            f"{np.median(ratio):.3f} ({ratio.max():.3f})",
            f"{np.median(late):.2f} ({late.max():.2f})",
            f"{int(values('flagged').sum())}",
            f"{np.median(values('seconds')):.0f} ({values('seconds').max():.0f})",
        )
    Console(width=150).print(table)
