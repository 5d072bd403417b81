"""``deal-hw calibrate``: find the simulator parameters that explain a recording."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import tyro

from deal_hw.calibration import Progress, ProgressCallback
from deal_hw.cli.calibrate_output import (
    print_files,
    print_lost,
    print_plain,
    print_result,
    print_verdict,
    show_progress,
)
from deal_hw.cli.json_output import only_document
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.ranges import Range
from deal_hw.types import FloatArray, Trajectory
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.result_folder import ResultFolder
from deal_hw.workflows.calibration.run import CalibrateReport, calibrate_input, finish
from deal_hw.workflows.calibration.settings import (
    RECORDINGS,
    CalibrateSettings,
    DriverDatasetSettings,
    FilesSettings,
    OwnDatasetSettings,
    Pairs,
    Triples,
    doubt_of,
    kind_of,
)
from deal_hw.workflows.calibration.space import write_parameters
from deal_hw.workflows.kinds import Kinds
from deal_hw.workflows.say import silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.sim.recordings.overlay import Overlay


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(CalibrateSettings):
    """What the verb can do beside the calibration."""

    free: tuple[str, ...] = ()

    known: Annotated[Pairs, Range(-1e12, 1e12)] = ()

    range: Annotated[Triples, Range(-1e12, 1e12)] = ()

    start_std: Annotated[Pairs, Range(0, 1e3)] = ()

    residual_std: tuple[str, ...] = ()

    out: Path | None = None
    """Run folder; results go to OUT/calibration. By default the folder that holds the dataset, or
    runs/MODEL."""

    resume: bool = False
    """Continue the calibration that was stopped in this folder; all other settings must be the same."""

    watch: bool = False
    """Show the population during the search: in a window, or in a browser if there is no desktop."""

    watch_save: Path | None = None
    """Write the view of --watch to a file, FILE.rrd."""

    report: bool = True
    """Write report.html, one page with all results; takes some seconds."""

    advise: bool = True
    """Compute which motion to record next if the data say little of a parameter; takes some seconds."""

    json: bool = False
    """Print one JSON document: the contents of result.json and the written files. Everything else that is
    printed goes to the error output."""

    quiet: bool = False
    """Print nothing but errors."""


@dataclass(frozen=True, kw_only=True)
class CalibrateDataset(CalibrateOptions, DriverDatasetSettings):
    """Find the simulator parameters that explain a dataset of a robot with a driver."""

    dataset: tyro.conf.Positional[Path]


@dataclass(frozen=True, kw_only=True)
class CalibrateOwnDataset(CalibrateOptions, OwnDatasetSettings):
    """Find the simulator parameters that explain a dataset with its own robot.yaml."""

    dataset: tyro.conf.Positional[Path]

    write_parameters: Path | None = None
    """Write a --parameters file for the robot's model, to edit, and end."""


@dataclass(frozen=True, kw_only=True)
class CalibrateFiles(CalibrateOptions, FilesSettings):
    """Find the simulator parameters that explain recordings of any robot.

    From its MuJoCo model and recordings of joint positions and commands.
    """

    model: Path = field(kw_only=True)

    data: tuple[Path, ...] = field(default=(), kw_only=True)

    holdout: tuple[Path, ...] = ()

    write_parameters: Path | None = None
    """Write a --parameters file for the model, to edit, and end."""


Calibrate: TypeAlias = CalibrateDataset | CalibrateOwnDataset | CalibrateFiles

CLASSES = {"dataset": CalibrateDataset, "own-robot": CalibrateOwnDataset, "model": CalibrateFiles}
TABLE = {name: dataclasses.replace(kind, settings=CLASSES[name]) for name, kind in RECORDINGS.items()}
KINDS = Kinds(
    noun="recordings",
    table=lambda: TABLE,
    find=lambda given: kind_of(given.first, given.options.get("model"), given.options, TABLE),
    doubt=lambda given: doubt_of(given.first),
    argument="dataset",
)


def check_words(words: Sequence[str]) -> None:
    """Refuse a model and its recordings without their options.

    Args:
        words: Arguments that do not parse.

    Raises:
        ConfigurationError: Several files come before the first option; the message has the right line.
    """
    names = list(itertools.takewhile(lambda word: not word.startswith("-"), words))
    if len(names) < 2:
        return
    models = [name for name in names if name.endswith(".xml")] or ["robot.xml"]
    recordings = [name for name in names if not name.endswith(".xml")]
    raise ConfigurationError(
        f"{' '.join(names)}: calibrate takes one dataset; name a model and its recordings by their options: "
        f"deal-hw calibrate --model {models[0]} --data {' '.join(recordings) or 'rec.csv'}"
    )


def calibrate_or_write_parameters(config: Calibrate) -> CalibrateReport | int:
    """Run the verb: calibrate, or write a file of parameters to edit.

    Raises:
        DealHwError: A setting or a recording is unusable; raised before any long work.
    """
    if not isinstance(config, CalibrateDataset) and config.write_parameters is not None:
        if config.json:
            raise ConfigurationError("--json would have no effect: --write-parameters calibrates nothing")
        path = write_parameters(config, config.write_parameters)
        source = (
            f"--model {config.model} --data ..."
            if isinstance(config, CalibrateFiles)
            else str(config.dataset)
        )
        again = f"deal-hw calibrate {source} --parameters {path}"
        print(f"written: {path}; edit it, then: {again}")
        return 0
    with only_document(config.json) as write:
        report = calibrate(config)
        files = {name: str(path) for name, path in report.files.items()}
        write({**json.loads(report.files["result.json"].read_text(encoding="utf-8")), "files": files})
    return report


def calibrate(config: Calibrate) -> CalibrateReport:
    """Calibrate, write the result folder, return both.

    Raises:
        DealHwError: A setting or a recording is unusable; raised before any long work.
    """
    config.check()
    say = silent if config.quiet else to_stderr
    results = ResultFolder(path=_run_folder(config) / "calibration", resume=config.resume)
    with _without_windows():
        work = calibration_input(config, say=say)
    method = usual_method(config, work, say)
    # What is shown is the robot without set-up.
    shown = work.robot.acting(work.space)
    with (
        results.resumable(),
        watching(
            config.watch, config.watch_save, shown, work.robot.description, work.shown, config.latency
        ) as watch,
        show_progress(f"calibrate ({method})", config.quiet) as bar,
    ):

        def progress(found: Progress) -> None:
            bar(found)
            if watch is not None:
                watch(found)

        result = calibrate_input(
            config,
            work,
            method,
            progress=progress,
            say=say,
            results=results,
        )
    report = finish(
        work,
        result,
        results,
        config.provenance,
        page=config.report,
        advise=config.advise,
        threads=config.threads,
    )
    if not config.quiet:
        print_result(report.result, work.advice, work.name)
        print_files(report.files)
        print_lost(report.result)
        print_plain(report.result)
        _print_next(report, work.name, results.path.parent)
        print_verdict(report.result)
    if report.problem is not None:
        raise report.problem
    return report


@contextlib.contextmanager
def watching(
    watch: bool,
    save: Path | None,
    space: ParameterSpace,
    description: RobotDescription,
    trajectory: Trajectory | None,
    latency_s: float | None,
) -> Iterator[ProgressCallback | None]:
    """Show a running search until the block ends.

    Args:
        watch: In a window, or in a browser if there is no desktop.
        save: File of the view, .rrd.
        space: The parameters.
        description: The robot.
        trajectory: The recording whose predictions are shown; None for none.
        latency_s: The latency, if it is known [s].

    Yields:
        A function to call with the progress; None if nothing is shown.
    """
    if trajectory is None or (not watch and save is None):
        yield None
        return
    try:
        from deal_hw.viz.live import live_viewer
        from deal_hw.viz.population_view import MEAN, population_view
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "viz") from err
    from deal_hw.sim.recordings.overlay import compute_overlay

    def predict(mean: FloatArray, population_latency_s: float) -> Overlay:
        latency = population_latency_s if latency_s is None else latency_s
        return compute_overlay(trajectory, description, space, {MEAN: mean}, latency_s=latency)

    with contextlib.ExitStack() as stack:
        address = ""
        if watch:
            address, page = stack.enter_context(live_viewer())
            if page:
                to_stderr(f"watch the search at {page}  (this machine only)")
        yield stack.enter_context(population_view(space, address=address, save=save, predict=predict)).show


@contextlib.contextmanager
def _without_windows() -> Iterator[None]:
    """Let MuJoCo be loaded without its library for windows, which starts a process to ask for its version.

    Not from Python: a program that calls :func:`deal_hw.calibrate` may draw with ``mujoco.Renderer`` later,
    which needs that library.
    """
    name, given = "MUJOCO_GL", os.environ.get("MUJOCO_GL")
    os.environ.setdefault(name, "disable")
    try:
        yield
    finally:
        if given is None:
            del os.environ[name]


def _print_next(report: CalibrateReport, robot: str, folder: Path) -> None:
    """Print the line that trains with the result, where there is a task and the result can be used."""
    from deal_hw.calib.report.verdict import trust
    from deal_hw.robots import has_task

    file = report.files.get("distribution.json")
    if file is not None and has_task(robot) and trust(report.result).colour != "red":
        print(f"to train with it: deal-hw train {robot} --distribution {file} --out {folder}")


def _run_folder(config: Calibrate) -> Path:
    if config.out is not None:
        return config.out
    if isinstance(config, CalibrateFiles):
        return Path("runs") / config.model.stem
    return config.dataset.resolve().parent
