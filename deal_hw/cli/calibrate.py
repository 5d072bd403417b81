"""``deal-hw calibrate``: find the simulator parameters that explain a recording."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from deal_hw.calibration import Progress
from deal_hw.cli.calibrate_output import print_files, print_result, print_verdict, show_progress
from deal_hw.cli.json_output import only_document
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.best_so_far import (
    CHECKPOINT,
    SO_FAR,
    check_resume,
    saying_how_to_resume,
    watching,
)
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.run import CalibrateReport, calibrate_input, finish
from deal_hw.workflows.calibration.settings import CalibrateSettings
from deal_hw.workflows.calibration.space import write_parameters
from deal_hw.workflows.options import refuse
from deal_hw.workflows.say import silent, to_stderr

__all__ = ["Calibrate", "CalibrateReport", "calibrate", "calibrate_or_write_parameters"]


@dataclass(frozen=True, kw_only=True)
class Calibrate(CalibrateSettings):
    """Find the simulator parameters that explain a recording.

    From a dataset, of a robot of deal-hw or with its own robot.yaml: deal-hw calibrate runs/first/dataset

    Of any robot, from its MuJoCo model and recordings of joint positions and commands:
    deal-hw calibrate --model robot.xml --data rec.csv --out runs/mine
    """

    dataset: tyro.conf.Positional[Path | None] = None

    out: Path | None = None
    """Run folder; results go to OUT/calibration. By default the folder that holds the dataset, or
    runs/MODEL."""

    residual_std: tuple[str, ...] = ()

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
    if config.recordings.write_parameters is not None:
        refuse(["--json"] if config.json else [], "--write-parameters calibrates nothing")
        path = write_parameters(config.recordings, config.dataset)
        model = config.recordings.model
        source = str(config.dataset) if model is None else f"--model {model} --data ..."
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
    folder = _run_folder(config) / "calibration"
    checkpoint = folder / CHECKPOINT
    check_resume(checkpoint, config.resume)
    work = calibration_input(config, say=say)
    method = usual_method(config, work, say)
    with (
        saying_how_to_resume(checkpoint),
        watching(
            config.watch, config.watch_save, work.space, work.robot.description, work.shown, config.latency
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
            checkpoint=checkpoint,
            resume=config.resume,
            keep=folder / SO_FAR,
        )
    report = finish(
        work,
        result,
        folder,
        config.provenance,
        checkpoint,
        page=config.report,
        advise=config.advise,
        threads=config.threads,
    )
    if not config.quiet:
        print_result(report.result, work.advice, work.name)
        print_files(report.files)
        _print_next(report, work.name, folder.parent)
        print_verdict(report.result)
    return report


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
    if config.dataset is not None:
        return config.dataset.resolve().parent
    return Path("runs") / Path(config.recordings.model or "model").stem
