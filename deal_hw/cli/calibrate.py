"""``deal-hw calibrate``: find the simulator parameters that explain a recording."""

from __future__ import annotations

import dataclasses
import importlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro

from deal_hw.calibration import Budget, CalibrationResult, Progress, ProgressCallback
from deal_hw.cli.calibrate_live import (
    CHECKPOINT,
    check_resume,
    open_checkpoint,
    saying_how_to_resume,
    watching,
)
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import Trajectory

if TYPE_CHECKING:
    from deal_hw.data.dataset import Dataset
    from deal_hw.sim.episode import Episode
    from deal_hw.sim.model import RobotModel

HELDOUT_PROFILE = "chirp"
TABLE_WIDTH = 100


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Find the simulator parameters that explain a recording."""

    dataset: tyro.conf.Positional[Path]
    """Dataset folder, such as runs/first/dataset."""

    out: Path | None = None
    """Run folder; results go to OUT/calibration. By default the folder that holds the dataset."""

    episodes: tuple[int, ...] = ()
    """Episodes to fit; by default all but the held-out ones."""

    holdout: tuple[int, ...] = ()
    """Episodes that only judge the result; by default those collected with --profile chirp."""

    method: str = "default"
    """How to search: default, weki, deal, deal-paper, ... (an unknown name lists all)."""

    space: str = ""
    """Which parameters: k9 (default: pole length and mass are known) or k11 (all)."""

    free: tuple[str, ...] = ()
    """Search exactly these parameters instead; the others keep their nominal values."""

    known: tuple[tuple[str, float], ...] = ()
    """Parameters measured by other means, as NAME VALUE pairs (SI)."""

    range: tuple[tuple[str, float, float], ...] = ()
    """Other search ranges, as NAME LOW HIGH (SI)."""

    xi: float = 5.0
    """Search each parameter within a factor XI to either side of its nominal value."""

    latency: float | None = None
    """Total latency [s] if it is known; by default it is searched."""

    population: int = 100
    """Members of the search."""

    generations: int = 50
    """Most generations of the search."""

    polish: bool = True
    """Follow the search by multiple shooting on prediction error."""

    seed: int = 0
    """Fixes everything random."""

    threads: int | None = None
    """Simulation threads; by default all CPUs."""

    resume: bool = False
    """Go on with the calibration that was stopped in this folder; all other settings must be the same."""

    watch: bool = False
    """Show the population while it searches: in a window, or in a browser where there is no desktop."""

    watch_save: Path | None = None
    """Write that view to a file, FILE.rrd."""

    report: bool = True
    """Write report.html, one page with everything; takes some seconds."""

    quiet: bool = False
    """Print nothing but errors."""


@dataclass(frozen=True, kw_only=True)
class CalibrateReport:
    """What a calibration wrote.

    Attributes:
        result: What was found.
        files: The files by name.
    """

    result: CalibrationResult
    files: dict[str, Path]


def calibrate(config: Calibrate) -> CalibrateReport:
    """Calibrate from a dataset, write the result folder, return both.

    Raises:
        DealHwError: A setting, a recording or the data are unusable; nothing long was begun.
    """
    from deal_hw.data.checks import Severity, check
    from deal_hw.data.dataset import Dataset
    from deal_hw.errors import InsufficientDataError

    dataset = Dataset.open(config.dataset)
    folder = (config.out or config.dataset.resolve().parent) / "calibration"
    checkpoint = folder / CHECKPOINT
    check_resume(checkpoint, config.resume)
    fit, holdout = choose_episodes(dataset, config.episodes, config.holdout)
    space = make_space(dataset.description["name"], config)
    recordings = {i: dataset.read(i).trajectory for i in (*fit, *holdout)}
    for index, trajectory in recordings.items():
        failed = [v.message for v in check(trajectory) if v.severity is Severity.FAIL]
        if failed:
            raise InsufficientDataError(
                f"episode {index} of {config.dataset} cannot be used: {'; '.join(failed)}; "
                "record again with `deal-hw collect`"
            )
    robot, episodes = _simulation(dataset, recordings)
    shown = recordings[fit[0]]
    with (
        saying_how_to_resume(checkpoint),
        watching(config.watch, config.watch_save, space, robot.description, shown, config.latency) as watch,
    ):
        result = calibrate_episodes(
            robot,
            space,
            [episodes[i] for i in fit],
            [episodes[i] for i in holdout],
            method=config.method,
            budget=Budget(population=config.population, generations=config.generations, polish=config.polish),
            rng=np.random.default_rng(config.seed),
            latency_s=config.latency,
            threads=config.threads,
            quiet=config.quiet,
            checkpoint=checkpoint,
            resume=config.resume,
            watch=watch,
        )
    result = dataclasses.replace(
        result,
        provenance={
            **result.provenance,
            "dataset": str(config.dataset),
            "description_digest": dataset.digest,
            "episodes": list(fit),
            "holdout": list(holdout),
            "seed": config.seed,
            "xi": config.xi,
            "versions": {
                name: metadata.version(name) for name in ("deal-hw", "mujoco", "numpy", "scipy", "torch")
            },
            "processors": len(os.sched_getaffinity(0)),
        },
    )
    from deal_hw.calib.folder import write_result

    report = None
    if config.report:
        from deal_hw.calib.report.gather import gather

        report = gather(
            robot,
            result,
            [episodes[i] for i in fit],
            [episodes[i] for i in holdout],
            telemetry=[
                f"episode {i}: {v.severity}: {v.message}" for i, t in recordings.items() for v in check(t)
            ],
            threads=config.threads,
        )
    files = write_result(folder, robot, result, report)
    checkpoint.unlink(missing_ok=True)
    if not config.quiet:
        print_result(result)
        print("written: " + ", ".join(str(f) for f in files.values()))
    return CalibrateReport(result=result, files=files)


def choose_episodes(
    dataset: Dataset, episodes: Sequence[int], holdout: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the episodes to fit and those to judge by.

    Raises:
        ConfigurationError: Nothing is left to fit, or an episode is in both.
    """
    every = range(len(dataset.episodes))
    profiles = {i: str(dataset.read(i).metadata.get("profile", "")) for i in every}
    held = tuple(holdout) or tuple(i for i in every if profiles[i] == HELDOUT_PROFILE and i not in episodes)
    fit = tuple(episodes) or tuple(i for i in every if i not in held)
    both = sorted(set(fit) & set(held))
    if both:
        raise ConfigurationError(
            f"episodes {both} are to be fitted and held out; a held-out episode must not be seen"
        )
    if not fit:
        raise ConfigurationError(
            f"nothing to fit: the dataset has {len(every)} episodes, {len(held)} of them held out; "
            "collect one with `deal-hw collect --profile rich`"
        )
    return fit, held


def make_space(robot: str, config: Calibrate) -> ParameterSpace:
    """Return the parameters to search.

    Raises:
        UnknownNameError: A name is not known; the message lists the names.
        ConfigurationError: A range is empty, reversed, or excludes the nominal value.
    """
    table = importlib.import_module(f"deal_hw.drivers.{robot}.description").SPACES
    name = config.space or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    space: ParameterSpace = table[name]()
    if config.free:
        space = space.with_free(config.free)
    space = space.with_ratio(config.xi)
    space = space.with_known(dict(config.known))
    for parameter, low, high in config.range:
        space = space.with_range(parameter, low, high)
    if not len(space):
        raise ConfigurationError("every parameter is known: there is nothing to search")
    return space


def _simulation(
    dataset: Dataset, recordings: Mapping[int, Trajectory]
) -> tuple[RobotModel, dict[int, Episode]]:
    try:
        from deal_hw.sim.episode import align
        from deal_hw.sim.model import load_model
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err
    from deal_hw.drivers import robot_description

    description = robot_description(dataset.description["name"])
    return load_model(description), {i: align(t, description) for i, t in recordings.items()}


def calibrate_episodes(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[Episode],
    holdout: Sequence[Episode],
    *,
    method: str,
    budget: Budget,
    rng: np.random.Generator,
    latency_s: float | None = None,
    threads: int | None = None,
    quiet: bool = True,
    checkpoint: Path | None = None,
    resume: bool = False,
    watch: ProgressCallback | None = None,
) -> CalibrationResult:
    """Calibrate from recordings on the device's time grid; the heart of the verb, without files.

    Args:
        robot: The nominal model.
        space: What to search.
        episodes: Recordings to fit.
        holdout: Recordings that only judge the result; the search never sees them.
        method: Name of the method.
        budget: How much it may use.
        rng: The only source of randomness.
        latency_s: Total latency if it is known [s].
        threads: Simulation threads.
        quiet: Show no progress.
        checkpoint: File that holds the state after each generation; None to keep none.
        resume: Go on with what that file holds.
        watch: Called with the progress, too.
    """
    try:
        from deal_hw.calib.methods import make_method
        from deal_hw.calib.problem import Problem
        from deal_hw.calib.validate import heldout_nrmse
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    problem = Problem(robot, space, episodes, threads=threads, fixed_latency_s=latency_s)
    searcher = make_method(method, polish=budget.polish)
    with show_progress(f"calibrate ({method})", quiet) as report:

        def progress(p: Progress) -> None:
            report(p)
            if watch is not None:
                watch(p)

        if checkpoint is None:
            result = searcher.run(problem, budget, rng, progress)
        else:
            store = open_checkpoint(checkpoint, resume, problem, searcher, budget, rng)
            result = searcher.run(problem, budget, rng, progress, store)
    if not holdout:
        return result
    errors = heldout_nrmse(
        robot, space, holdout,
        {"nominal": (space.nominal, 0.0), "calibrated": (result.estimate, result.latency_s)}, threads=threads,
    )  # fmt: skip
    return dataclasses.replace(result, heldout_nrmse=errors)


@contextmanager
def show_progress(title: str, quiet: bool) -> Iterator[ProgressCallback]:
    """Show a progress bar on a terminal; nothing otherwise."""
    if quiet or not sys.stderr.isatty():
        yield lambda progress: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None, note="")

        def report(p: Progress) -> None:
            bar.update(
                task, description=f"{title}: {p.stage}", completed=p.done, total=p.total, note=p.message
            )

        yield report


def print_result(result: CalibrationResult) -> None:
    """Print the parameters with their intervals, and what the data cannot tell."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"calibration by {result.method}: {result.seconds:.0f} s, chi2 {result.chi2:.3g}")
    for name, align in (
        ("parameter", "left"), ("unit", "left"), ("nominal", "right"), ("estimate", "right"),
        ("90 % interval", "left"), ("verdict", "left"),
    ):  # fmt: skip
        table.add_column(name, justify="right" if align == "right" else "left")
    for k, p in enumerate(result.space):
        low, high = result.interval[k]
        verdict = result.verdicts[k] if result.verdicts else "-"
        table.add_row(
            p.name,
            p.unit,
            f"{p.nominal:.4g}",
            f"{result.estimate[k]:.4g}",
            f"{low:.4g} .. {high:.4g}",
            verdict,
        )
    low_ms, high_ms = (1e3 * v for v in result.latency_interval_s)
    table.add_row("latency", "ms", "0", f"{1e3 * result.latency_s:.2f}", f"{low_ms:.2f} .. {high_ms:.2f}", "")
    console = Console()
    if console.width < TABLE_WIDTH:
        console = Console(width=TABLE_WIDTH)
    console.print(table)
    for words in result.null_directions:
        console.print(f"the data cannot tell: {words}")
    for words in result.alarms:
        console.print(f"[bold]alarm:[/bold] {words}")
    if result.heldout_nrmse:
        errors = ", ".join(f"{name} {value:.4f}" for name, value in result.heldout_nrmse.items())
        console.print(f"held-out error over the signal's range (0.2 s windows): {errors}")
    else:
        console.print(
            "no held-out episode: nothing says whether this holds on other motion; "
            "`deal-hw collect --profile chirp` records one"
        )
