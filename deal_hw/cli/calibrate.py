"""``deal-hw calibrate``: find the simulator parameters that explain a recording."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from deal_hw.calib.methods import CLOSED_LOOP_METHODS, check_method, usual_population
from deal_hw.calibration import LATENCY_RANGE_S, Budget
from deal_hw.cli.calibrate_live import CHECKPOINT, SO_FAR, check_resume, saying_how_to_resume, watching
from deal_hw.cli.calibrate_model import Recordings, prepare_model, write_parameters
from deal_hw.cli.calibrate_policy import recorded_policy
from deal_hw.cli.calibrate_run import (
    HELDOUT_WINDOW_S,
    CalibrateReport,
    CalibrationInputs,
    SpaceOverrides,
    calibrate_episodes,
    finish,
    residual_std,
)
from deal_hw.cli.options import Checked, Range, Ratio, Seed, Threads, given, refuse
from deal_hw.cli.run_plan import balancer
from deal_hw.control.velocity_error import wanted_velocity
from deal_hw.data.recording.spikes import DEFAULT_SPIKES, SpikeSettings
from deal_hw.drivers import parameter_spaces, recorded_description
from deal_hw.errors import ConfigurationError, MissingExtraError, UnknownNameError
from deal_hw.parameters import LONGEST_LATENCY_S, ParameterSpace
from deal_hw.types import Trajectory

if TYPE_CHECKING:
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import Episode

__all__ = [
    "Calibrate", "CalibrateReport", "calibrate", "calibrate_episodes", "calibrate_or_write_parameters",
    "make_space",
]  # fmt: skip

HELDOUT_PROFILE = "chirp"
DEFAULT = "default"
GAIT_SMOOTHING_S = 0.04
"""Feet that land change joint velocities within some 10 ms: longer smoothing bends states there [s]."""
WALK_TELLS = (
    "a walk tells the gains of the joints and the floor's friction; it hardly tells their dry friction, not "
    "their armature, and masses only where the motors' efforts weigh the robot (docs/calibration.md)"
)
WEIGHING_S = 0.35
"""A robot that is about to walk has stood still for so long [s]."""
SAMPLES_A_PERIOD = 4
"""States of a control period that are fitted to."""


@dataclass(frozen=True, kw_only=True)
class Calibrate(Checked):
    """Find the simulator parameters that explain a recording.

    Of a robot that deal-hw drives:  deal-hw calibrate runs/first/dataset

    Of any robot, from its MuJoCo model and recordings of joint positions and commands:
    deal-hw calibrate --model robot.xml --data rec.csv --out runs/mine    (docs/any-robot.md)
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
    """Which parameters of a robot of ours, such as k9 or k11 (docs/parameters.md); the first by default."""

    free: tuple[str, ...] = ()
    """Search exactly these parameters instead; the others keep their nominal values."""

    known: Annotated[tuple[tuple[str, float], ...], Range(-1e12, 1e12)] = ()
    """Parameters measured by other means, as NAME VALUE pairs (SI)."""

    range: Annotated[tuple[tuple[str, float, float], ...], Range(-1e12, 1e12)] = ()
    """Other search ranges, as NAME LOW HIGH (SI)."""

    xi: Annotated[float | None, Ratio] = None
    """Search each parameter within a factor XI to either side of its nominal value. By default as its
    parameter set says, mostly 5; with --model 20 for dry friction (docs/parameters.md), and with --parameters
    the ranges of that file."""

    latency: Annotated[float | None, Range(0, LONGEST_LATENCY_S, "s")] = None
    """Total latency [s] if it is known; by default it is searched."""

    latency_range: Annotated[tuple[float, float], Range(0, LONGEST_LATENCY_S, "s")] = LATENCY_RANGE_S
    """Latencies that are searched, LOW HIGH [s]. An estimate at the end is an alarm: widen the range then."""

    spike_ratio: Annotated[float, Range(1, 1e6)] = DEFAULT_SPIKES.ratio
    """Leave out up to three samples in a row that jump away and come back, so many times farther than the
    joint's fastest motion would take it (docs/calibration.md). A larger number leaves out less."""

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
    if config.method not in CLOSED_LOOP_METHODS:
        refuse(given(config, Calibrate(), ("policy",)), f"--method {config.method} runs no policy")
    elif source.model is not None:
        raise ConfigurationError(
            f"--method {config.method} runs the policy that moved the robot, which recordings of --model do "
            "not name; use eki, deal or deal-paper-replay"
        )
    folder = _run_folder(config) / "calibration"
    checkpoint = folder / CHECKPOINT
    check_resume(checkpoint, config.resume)
    population = config.population or usual_population(config.method)
    budget = Budget(population=population, generations=config.generations, refine=config.refine)
    work = prepare(config)
    known_std = residual_std(config.residual_std, work.robot)
    method = usual_method(config, work.robot, walks=work.walks)
    with (
        saying_how_to_resume(checkpoint),
        watching(
            config.watch, config.watch_save, work.space, work.robot.description, work.shown, config.latency
        ) as watch,
    ):
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
            quiet=config.quiet,
            checkpoint=checkpoint,
            resume=config.resume,
            watch=watch,
            keep=folder / SO_FAR,
            known_std=known_std,
            heldout_window_s=config.heldout_window,
            smoothing_s=GAIT_SMOOTHING_S if work.walks else None,
            policy=work.policy,
        )
    settings: dict[str, Any] = {
        "seed": config.seed,
        "xi": config.xi,
        "heldout_window_s": config.heldout_window,
        "latency_range_s": None if config.latency is not None else list(config.latency_range),
    }
    if config.residual_std:
        settings["residual_std"] = list(config.residual_std)
    return finish(
        work,
        result,
        folder,
        settings,
        checkpoint,
        page=config.report,
        advise=config.advise,
        threads=config.threads,
        quiet=config.quiet,
    )


def prepare(config: Calibrate) -> CalibrationInputs:
    """Read and check what is to be calibrated.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    return prepare_dataset(config) if config.recordings.model is None else _prepare_model(config)


def usual_method(config: Calibrate, robot: RobotModel, *, walks: bool = False) -> str:
    """Return the method, where none is named that which suits the recordings."""
    if config.method != DEFAULT or config.residual_std or not config.refine:
        return config.method
    facts = robot.description
    held = set(facts.actuated) == set(facts.joint_names) and all(kp > 0 for kp in facts.stiffness)
    if walks:
        usual = "gait"
        if not config.quiet:
            print(WALK_TELLS, file=sys.stderr)
    elif config.recordings.model is not None and robot.base is None and held:
        usual = "output-error"
    else:
        # Predictions of seconds, which output-error compares, mean nothing for a robot that falls.
        return config.method
    if not config.quiet:
        print(f"method: {usual} (--method eki to search and refine to the sensor noise)", file=sys.stderr)
    return usual


def _run_folder(config: Calibrate) -> Path:
    if config.out is not None:
        return config.out
    if config.dataset is not None:
        return config.dataset.resolve().parent
    return Path("runs") / Path(config.recordings.model or "model").stem


def _overrides(config: Calibrate, xi: float | None) -> SpaceOverrides:
    return SpaceOverrides(free=config.free, known=dict(config.known), ranges=config.range, xi=xi)


def _prepare_model(config: Calibrate) -> CalibrationInputs:
    refuse(
        given(config, Calibrate(), ("episodes", "space", "sample_hz")),
        "only datasets take that; with --model use --data and --parameters",
    )
    holdout = [Path(str(path)) for path in config.holdout]
    return prepare_model(
        config.recordings,
        holdout,
        _overrides(config, config.xi),
        std=lambda robot: residual_std(config.residual_std, robot),
        spikes=SpikeSettings(ratio=config.spike_ratio),
        threads=config.threads,
        quiet=config.quiet,
    )


def prepare_dataset(config: Calibrate) -> CalibrationInputs:
    """Read a dataset of a robot of ours.

    Raises:
        DealHwError: A setting or a recording is unusable.
    """
    from deal_hw.data.recording.dataset import Dataset
    from deal_hw.data.recording.spikes import without_spikes
    from deal_hw.data.recording.telemetry_checks import Severity, check
    from deal_hw.errors import InsufficientDataError

    if config.dataset is None:
        raise ConfigurationError("no dataset was named")
    wrong = [str(i) for i in config.holdout if not isinstance(i, int)]
    if wrong:
        raise ConfigurationError(
            f"--holdout {' '.join(wrong)}: of a dataset name episodes by number; files go with --model"
        )
    dataset = Dataset.open(config.dataset)
    held = [int(str(i)) for i in config.holdout]
    fit, holdout = choose_episodes(dataset, config.episodes, held)
    policy = None
    if config.method in CLOSED_LOOP_METHODS:
        description = recorded_description(dataset.description["name"])
        policy = recorded_policy(dataset, fit, description, config.policy)
    space = make_space(dataset.description["name"], config)
    recordings = {i: dataset.read(i).trajectory for i in (*fit, *holdout)}
    spikes = SpikeSettings(ratio=config.spike_ratio)
    verdicts = {index: check(trajectory, spikes) for index, trajectory in recordings.items()}
    for index, found in verdicts.items():
        failed = [v.message for v in found if v.severity is Severity.FAIL]
        if failed:
            raise InsufficientDataError(
                f"episode {index} of {config.dataset} cannot be used: {'; '.join(failed)}; "
                "record again with `deal-hw collect`"
            )
        jumps = [v.message for v in found if v.name == "spikes" and v.severity is Severity.WARN]
        if jumps and not config.quiet:
            print(f"episode {index}: {jumps[0]}", file=sys.stderr)
    recordings = {index: without_spikes(trajectory, spikes) for index, trajectory in recordings.items()}
    robot, episodes = _simulation(dataset, recordings, config.sample_hz)
    walks = robot.base is not None and all(
        wanted_velocity(recordings[i]) is not None for i in (*fit, *holdout)
    )
    if walks:
        space = _weighed(space, robot, recordings[fit[0]], quiet=config.quiet)
    return CalibrationInputs(
        robot=robot,
        space=space,
        episodes=[episodes[i] for i in fit],
        holdout=[episodes[i] for i in holdout],
        shown=recordings[fit[0]],
        telemetry=[f"episode {i}: {v.severity}: {v.message}" for i, found in verdicts.items() for v in found],
        provenance={
            "dataset": str(config.dataset),
            "description_digest": dataset.digest,
            "episodes": list(fit),
            "holdout": list(holdout),
        },
        advice="`deal-hw collect --profile chirp` records one",
        balance=balancer(robot.description, None),
        name="" if robot.base is not None else robot.description.name,
        walks=walks,
        policy=policy,
    )


def choose_episodes(
    dataset: Dataset, episodes: Sequence[int], holdout: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the episodes to fit and those to judge by.

    Raises:
        ConfigurationError: Nothing is left to fit, or an episode is in both.
    """
    every = range(len(dataset.episodes))
    metadata = [dataset.read(i).metadata for i in every]
    profiles = [str(m.get("profile", "")) for m in metadata]
    held = tuple(holdout) or tuple(i for i in every if profiles[i] == HELDOUT_PROFILE and i not in episodes)
    repeated = [] if episodes else [i for i in every[:-1] if _repeats(metadata[i + 1], metadata[i])]
    if repeated:
        print(
            f"episodes {repeated} hardly moved and were recorded again: not fitted (--episodes names others)",
            file=sys.stderr,
        )
    fit = tuple(episodes) or tuple(i for i in every if i not in held and i not in repeated)
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


def _repeats(one: Mapping[str, Any], former: Mapping[str, Any]) -> bool:
    """Say whether a recording is the livelier repetition of the one before, by their metadata."""
    same = all(one.get(key) == former.get(key) for key in ("profile", "seed", "seconds"))
    return same and one.get("attempt", 0) == former.get("attempt", 0) + 1


def make_space(robot: str, config: Calibrate) -> ParameterSpace:
    """Return the parameters to search.

    Raises:
        UnknownNameError: A name is not known; the message lists the names.
        ConfigurationError: A range is empty, reversed, or excludes the nominal value.
    """
    table = parameter_spaces(robot)
    name = config.space or next(iter(table))
    if name not in table:
        raise UnknownNameError("parameter set", name, table)
    return _overrides(config, config.xi).apply(table[name]())


def _simulation(
    dataset: Dataset, recordings: Mapping[int, Trajectory], sample_hz: float | None
) -> tuple[RobotModel, dict[int, Episode]]:
    try:
        from deal_hw.sim.engine.model import load_model
        from deal_hw.sim.recordings.episode import align, thin
        from deal_hw.sim.recordings.standing import with_sensed_base
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    robot = load_model(recorded_description(dataset.description["name"]))
    episodes = {}
    for i, trajectory in recordings.items():
        episodes[i] = align(trajectory, robot.description)
        if robot.base is not None and trajectory.body is not None:
            episodes[i] = _while_walking(with_sensed_base(episodes[i], robot, trajectory), trajectory)
        episodes[i] = thin(episodes[i], sample_hz or SAMPLES_A_PERIOD * robot.description.control_rate_hz)
    return robot, episodes


def _while_walking(episode: Episode, trajectory: Trajectory) -> Episode:
    """Return the episode without standing up and lying down where it is of a walk."""
    wanted = wanted_velocity(trajectory)
    if wanted is None:
        return episode
    rows = slice(episode.first_row, episode.first_row + len(episode.sample))
    host_s = trajectory.device_s[rows] + np.median(trajectory.receive_s - trajectory.device_s)
    walks = (host_s >= wanted.time_s[0]) & (host_s <= wanted.end_s)
    return dataclasses.replace(episode, usable=episode.usable & walks)


def _weighed(
    space: ParameterSpace, robot: RobotModel, trajectory: Trajectory, *, quiet: bool
) -> ParameterSpace:
    """Return the space with the trunk's mass as the robot weighs itself, where that is searched.

    No motion on feet tells masses and gains apart: all forces scale together. The motors' efforts do, in the
    last moments before the robot walks.
    """
    from deal_hw.sim.legged.weighing import standing_mass

    trunk, wanted, body = robot.description.floating_base, wanted_velocity(trajectory), trajectory.body
    names = [p.name for p in space if p.kind == "body_mass" and p.elements == (trunk,)]
    if not names or wanted is None or body is None:
        return space
    since_s = trajectory.receive_s - wanted.time_s[0]
    rows = (since_s > -WEIGHING_S) & (since_s < 0) & np.isfinite(trajectory.effort).all(axis=1)
    if not rows.any():
        return space
    whole = standing_mass(robot, body.orientation[rows], trajectory.position[rows], trajectory.effort[rows])
    mass = whole - float(robot.model.body_mass.sum() - robot.model.body(trunk).mass[0])
    if not quiet:
        print(
            f"{names[0]}: {mass:.2f} kg, by the motors' efforts while the robot stands (the whole robot "
            f"{whole:.2f} kg); not fitted, --known {names[0]} KG gives another",
            file=sys.stderr,
        )
    return space.with_known({names[0]: mass})
