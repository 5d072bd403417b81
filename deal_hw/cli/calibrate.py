"""``deal-hw calibrate``: find the simulator parameters that explain a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from deal_hw.calib.methods import check_method, usual_budget
from deal_hw.calibration import LATENCY_RANGE_S, Progress
from deal_hw.cli.calibrate_output import print_result, show_progress
from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.workflows.calibration.best_so_far import (
    CHECKPOINT,
    SO_FAR,
    check_resume,
    saying_how_to_resume,
    watching,
)
from deal_hw.workflows.calibration.dataset import DatasetRecordings, prepare_dataset
from deal_hw.workflows.calibration.model import (
    DEFAULT,
    Recordings,
    method_for,
    prepare_model,
    write_parameters,
)
from deal_hw.workflows.calibration.policy import check_policy
from deal_hw.workflows.calibration.run import (
    HELDOUT_WINDOW_S,
    CalibrateReport,
    CalibrationInputs,
    SpaceOverrides,
    calibrate_episodes,
    finish,
    residual_std,
)
from deal_hw.workflows.calibration.walking import WALK_TELLS
from deal_hw.workflows.options import Checked, Range, Ratio, Seed, Threads, given, refuse
from deal_hw.workflows.say import Say, aloud, silent

if TYPE_CHECKING:
    pass

__all__ = [
    "Calibrate",
    "CalibrateReport",
    "calibrate",
    "calibrate_episodes",
    "calibrate_or_write_parameters",
]


@dataclass(frozen=True, kw_only=True)
class Calibrate(Checked):
    """Find the simulator parameters that explain a recording.

    Of a robot that deal-hw drives:  deal-hw calibrate runs/first/dataset

    Of any robot, from its MuJoCo model and recordings of joint positions and commands:
    deal-hw calibrate --model robot.xml --data rec.csv --out runs/mine    (docs/tutorials/your-robot.md)
    """

    dataset: tyro.conf.Positional[Path | None] = None
    """Dataset folder, such as runs/first/dataset; left out with --model."""

    recordings: tyro.conf.OmitArgPrefixes[Recordings] = field(default_factory=Recordings)

    out: Path | None = None
    """Run folder; results go to OUT/calibration. By default the folder that holds the dataset, or
    runs/MODEL."""

    episodes: Annotated[tuple[int, ...], Range(0, 1_000_000)] = ()
    """Episodes of the dataset to fit; by default all but the held-out ones."""

    holdout: Annotated[tuple[int | Path, ...], Range(0, 1_000_000)] = ()
    """What only judges the result: episodes of the dataset (by default those collected with --profile chirp),
    or with --model recordings (by default the last part of each, --holdout-part)."""

    heldout_window: Annotated[float, Range(1e-3, 600, "s")] = HELDOUT_WINDOW_S
    """Held-out predictions restart from the measured state this often [s]."""

    method: str = DEFAULT
    """How to search: default, output-error, eki, deal, deal-paper, ... (an unknown name lists all). The
    default is eki and its refinement; of a walk it is gait; with --model, for a robot that servos hold on a
    fixed base, it is output-error unless --residual-std or --no-refine say how to treat what no model
    explains."""

    policy: Path | None = None
    """The policy (.onnx) that moved the robot, for deal-paper and other methods that run it in every
    simulator; by default the copy that the dataset keeps."""

    space: str = ""
    """Which parameters of a robot of ours, such as k9 or k11 (docs/reference/parameters.md); the first by
    default."""

    free: tuple[str, ...] = ()
    """Search exactly these parameters instead; the others keep their nominal values."""

    known: Annotated[tuple[tuple[str, float], ...], Range(-1e12, 1e12)] = ()
    """Parameters measured by other means, as NAME VALUE pairs (SI)."""

    range: Annotated[tuple[tuple[str, float, float], ...], Range(-1e12, 1e12)] = ()
    """Other search ranges, as NAME LOW HIGH (SI)."""

    range_ratio: Annotated[float | None, Ratio] = None
    """Search each parameter within a factor RANGE-RATIO to either side of its nominal value. By default as
    its parameter set says, mostly 5; with --model 20 for dry friction (docs/reference/parameters.md), and
    with --parameters the ranges of that file."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency [s] if it is known; by default it is searched."""

    latency_range: Annotated[tuple[float, float], Range(0, LONGEST_LATENCY_S, "s")] = LATENCY_RANGE_S
    """Latencies that are searched, LOW HIGH [s]. An estimate at the end is an alarm: widen the range then."""

    spike_ratio: Annotated[float, Range(1, 1e6)] = DEFAULT_SPIKES.ratio
    """Leave out up to three samples in a row that jump away and come back, so many times farther than the
    joint's fastest motion would take it (docs/explanation/calibration.md). A larger number leaves out
    less."""

    residual_std: tuple[str, ...] = ()
    """What a prediction may be off [rad, m]: sensor noise and what no model has. One number, or NAME VALUE
    pairs of joints; by default the sensor noise, estimated. On real robots some milliradians often serve
    better."""

    sample_hz: Annotated[float | None, Range(1, 1e5, "Hz")] = None
    """Fit to about so many states a second of a dataset; by default to four a control period. What was held
    out is judged at the same rate."""

    population: Annotated[int | None, Range(2, 100_000)] = None
    """Members of the search; by default 100, for methods of the paper 200."""

    generations: Annotated[int, Range(1, 100_000)] = 50
    """Most generations of the search."""

    refine: bool = True
    """Follow the search by multiple shooting on prediction error."""

    seed: Seed = 0
    """Fixes everything random."""

    threads: Threads = None
    """Simulation threads; by default all CPUs."""

    resume: bool = False
    """Go on with the calibration that was stopped in this folder; all other settings must be the same."""

    watch: bool = False
    """Show the population while it searches: in a window, or in a browser where there is no desktop."""

    watch_save: Path | None = None
    """Write that view to a file, FILE.rrd."""

    report: bool = True
    """Write report.html, one page with everything; takes some seconds."""

    advise: bool = True
    """Compute what to record next where a parameter stayed weak or open; takes some seconds then."""

    quiet: bool = False
    """Print nothing but errors."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.latency_range
        if not low < high:
            raise ConfigurationError(f"--latency-range {low:g} {high:g}: give the lower one first")


def calibrate_or_write_parameters(config: Calibrate) -> CalibrateReport | int:
    """Run the verb: calibrate, or write a file of parameters to edit.

    Raises:
        DealHwError: A setting, a recording or the data are unusable; nothing long was begun.
    """
    if config.recordings.write_parameters is not None:
        return write_parameters(config.recordings)
    return calibrate(config)


def calibrate(config: Calibrate) -> CalibrateReport:
    """Calibrate, write the result folder, return both.

    Raises:
        DealHwError: A setting, a recording or the data are unusable; nothing long was begun.
    """
    source = config.recordings
    if (config.dataset is None) == (source.model is None):
        raise ConfigurationError(
            "name a dataset (deal-hw calibrate runs/first/dataset), or a model and its recordings "
            "(deal-hw calibrate --model robot.xml --data rec.csv), not both"
        )
    if source.model is None:
        refuse(
            given(source, Recordings()),
            "a dataset says it; that goes with --model and --data",
        )
    if config.latency is not None:
        refuse(given(config, Calibrate(), ("latency_range",)), "--latency says the latency")
    check_method(config.method)
    check_policy(config.method, given=config.policy is not None, model=source.model is not None)
    folder = _run_folder(config) / "calibration"
    checkpoint = folder / CHECKPOINT
    check_resume(checkpoint, config.resume)
    budget = usual_budget(config.method, config.population, config.generations, refine=config.refine)
    work = prepare(config)
    known_std = residual_std(config.residual_std, work.robot)
    method = usual_method(config, work)
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

        result = calibrate_episodes(
            work.robot,
            work.space,
            work.episodes,
            work.holdout,
            method=method,
            budget=budget,
            rng=np.random.default_rng(config.seed),
            latency_s=config.latency,
            latency_range_s=config.latency_range,
            threads=config.threads,
            progress=progress,
            say=_say(config),
            checkpoint=checkpoint,
            resume=config.resume,
            keep=folder / SO_FAR,
            known_std=known_std,
            heldout_window_s=config.heldout_window,
            policy=work.policy,
            smoothing_s=work.smoothing_s,
        )
    settings: dict[str, Any] = {
        "seed": config.seed,
        "range_ratio": config.range_ratio,
        "heldout_window_s": config.heldout_window,
        "latency_range_s": None if config.latency is not None else list(config.latency_range),
    }
    if config.residual_std:
        settings["residual_std"] = list(config.residual_std)
    report = finish(
        work,
        result,
        folder,
        settings,
        checkpoint,
        page=config.report,
        advise=config.advise,
        threads=config.threads,
    )
    if not config.quiet:
        print_result(report.result, work.advice, work.name)
        print("written: " + ", ".join(str(f) for f in report.files.values()))
    return report


def prepare(config: Calibrate) -> CalibrationInputs:
    """Read and check what is to be calibrated.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    return prepare_recorded(config) if config.recordings.model is None else _prepare_model(config)


def usual_method(config: Calibrate, work: CalibrationInputs) -> str:
    """Return the method, where none is named that which suits the recordings."""
    if config.method != DEFAULT:
        return config.method
    told = bool(config.residual_std) or not config.refine
    method = method_for(work, told=told, real=config.recordings.model is not None)
    say = _say(config)
    if work.walks and not told:
        say(WALK_TELLS)
    if method != DEFAULT:
        say(f"method: {method} (--method eki to search and refine to the sensor noise)")
    return method


def _run_folder(config: Calibrate) -> Path:
    if config.out is not None:
        return config.out
    if config.dataset is not None:
        return config.dataset.resolve().parent
    return Path("runs") / Path(config.recordings.model or "model").stem


def _overrides(config: Calibrate, range_ratio: float | None) -> SpaceOverrides:
    return SpaceOverrides(
        free=config.free, known=dict(config.known), ranges=config.range, range_ratio=range_ratio
    )


def _prepare_model(config: Calibrate) -> CalibrationInputs:
    refuse(
        given(config, Calibrate(), ("episodes", "space", "sample_hz")),
        "only datasets take that; with --model use --data and --parameters",
    )
    holdout = [Path(str(path)) for path in config.holdout]
    return prepare_model(
        config.recordings,
        holdout,
        _overrides(config, config.range_ratio),
        std=lambda robot: residual_std(config.residual_std, robot),
        spikes=SpikeSettings(ratio=config.spike_ratio),
        threads=config.threads,
        say=_say(config),
    )


def prepare_recorded(config: Calibrate) -> CalibrationInputs:
    """Read the dataset that the settings name.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    wrong = [str(i) for i in config.holdout if not isinstance(i, int)]
    if config.dataset is None or wrong:
        raise ConfigurationError(
            f"--holdout {' '.join(wrong)}: of a dataset name episodes by number; files go with --model"
            if wrong
            else "no dataset was named"
        )
    source = DatasetRecordings(
        folder=config.dataset,
        episodes=config.episodes,
        holdout=[int(str(i)) for i in config.holdout],
        policy=config.policy,
        sample_hz=config.sample_hz,
        spikes=SpikeSettings(ratio=config.spike_ratio),
    )
    return prepare_dataset(
        source, config.space, _overrides(config, config.range_ratio), config.method, _say(config)
    )


def _say(config: Calibrate) -> Say:
    return silent if config.quiet else aloud
