"""What every calibration does once its recordings are on the device's grid: search, judge, report, write."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calibration import (
    BEFORE_SEARCH,
    LATENCY_RANGE_S,
    Budget,
    CalibrationResult,
    Progress,
    ProgressCallback,
)
from deal_hw.errors import ConfigurationError, InsufficientDataError, MissingExtraError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray, Trajectory
from deal_hw.workflows.calibration.best_so_far import (
    SO_FAR,
    BestSoFar,
    keeping_best,
    open_checkpoint,
    saying_how_to_resume,
)
from deal_hw.workflows.calibration.walking import GAIT_SMOOTHING_S
from deal_hw.workflows.options import Range
from deal_hw.workflows.say import Say, aloud, silent

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import PopulationPolicy
    from deal_hw.calib.report.gather import ReportInputs
    from deal_hw.control.behaviours import Behaviour
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode

HELDOUT_WINDOW_S = 0.2
"""The same as in :mod:`deal_hw.calib.validation.metrics`, which is loaded on need."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationInputs:
    """What is to be calibrated, read and checked.

    Attributes:
        robot: The nominal model.
        space: What to search.
        episodes: Recordings to fit.
        holdout: Recordings that only judge the result.
        shown: The recording that ``--watch`` shows.
        telemetry: Verdicts on the recordings, for the report.
        provenance: Where all of it comes from: plain JSON values.
        advice: How to get a held-out recording where there is none.
        balance: Makes the policy that balances the robot in advised motions; None: it stands by itself.
        name: Name under which `deal-hw collect` records this robot; "" where it does not.
        walks: Whether all recordings are of a policy that walks.
        policy: What moved the robot all through the recordings, where the method needs it.
    """

    robot: RobotModel
    space: ParameterSpace
    episodes: Sequence[SampledEpisode]
    holdout: Sequence[SampledEpisode]
    shown: Trajectory
    telemetry: Sequence[str]
    provenance: Mapping[str, Any]
    advice: str
    balance: Callable[[], Behaviour] | None = None
    name: str = ""
    walks: bool = False
    policy: PopulationPolicy | None = None

    @property
    def smoothing_s(self) -> float | None:
        """Over how long start states are smoothed [s]; None for the usual time."""
        return GAIT_SMOOTHING_S if self.walks else None


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceOverrides:
    """What the command line changes about a parameter space.

    Attributes:
        free: Search exactly these; empty: as the space has it.
        known: Values measured by other means, by name (SI).
        ranges: Other ranges: name, low, high (SI).
        range_ratio: Log ranges reach this factor to either side of the nominal value; None: as the space has
            them.
    """

    free: Sequence[str]
    known: Mapping[str, float]
    ranges: Sequence[tuple[str, float, float]]
    range_ratio: float | None

    def apply(self, space: ParameterSpace) -> ParameterSpace:
        """Return the changed space.

        Raises:
            UnknownNameError: A name is not known; the message lists the names.
            ConfigurationError: A range is empty, reversed, or excludes the nominal value; or nothing is left.
        """
        if self.free:
            space = space.with_free(self.free)
        if self.range_ratio is not None:
            space = space.with_ratio(self.range_ratio)
        space = space.with_known(self.known)
        for parameter, low, high in self.ranges:
            space = space.with_range(parameter, low, high)
        if not len(space):
            raise ConfigurationError("every parameter is known: there is nothing to search")
        return space


@dataclass(frozen=True, kw_only=True)
class CalibrateReport:
    """What a calibration wrote.

    Attributes:
        result: What was found.
        files: The files by name.
    """

    result: CalibrationResult
    files: dict[str, Path]


def calibrate_episodes(
    robot: RobotModel,
    space: ParameterSpace,
    episodes: Sequence[SampledEpisode],
    holdout: Sequence[SampledEpisode],
    *,
    method: str,
    budget: Budget,
    rng: np.random.Generator,
    latency_s: float | None = None,
    latency_range_s: tuple[float, float] = LATENCY_RANGE_S,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    say: Say = silent,
    checkpoint: Path | None = None,
    resume: bool = False,
    keep: Path | None = None,
    known_std: FloatArray | None = None,
    heldout_window_s: float = HELDOUT_WINDOW_S,
    smoothing_s: float | None = None,
    policy: PopulationPolicy | None = None,
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
        latency_range_s: Otherwise what is searched [s].
        threads: Simulation threads.
        progress: Called with the progress.
        say: Called with a sentence where a better fit was found, and where it is kept.
        checkpoint: File that holds the state after each generation; None to keep none.
        resume: Go on with what that file holds.
        keep: Folder that gets the best fit so far on Ctrl-C; None to keep none.
        known_std: What a prediction may be off, positions then velocities, (2 C,); None: the sensor noise, as
            the recordings show it.
        heldout_window_s: Held-out predictions restart this often [s].
        smoothing_s: Start states are smoothed over so long [s]; None for the usual time.
        policy: What moved the robot all through the recordings, for methods that need it.
    """
    try:
        from threadpoolctl import threadpool_limits

        from deal_hw.calib.data.checks import check_delays
        from deal_hw.calib.data.noise import SETTINGS as DATA
        from deal_hw.calib.data.problem import Problem
        from deal_hw.calib.methods import make_method
        from deal_hw.calib.validation.metrics import HeldOut
        from deal_hw.calib.validation.verdict import latency_alarms
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    _require_windows(holdout, heldout_window_s)
    problem = Problem(
        robot,
        space,
        episodes,
        threads=threads,
        latency_range_s=latency_range_s,
        fixed_latency_s=latency_s,
        known_std=known_std,
        settings=DATA if smoothing_s is None else dataclasses.replace(DATA, smoothing_s=smoothing_s),
        policy=policy,
    )
    check_delays(problem)

    held_out = HeldOut(robot, space, holdout, heldout_window_s, threads) if holdout else None

    def beside_nominal(theta: FloatArray, latency: float) -> dict[str, tuple[FloatArray, float]]:
        return {"nominal": (space.nominal, 0.0), "calibrated": (theta, latency)}

    judge = None if held_out is None else lambda *fit: held_out.errors(beside_nominal(*fit)).nrmse
    best = BestSoFar(space, judge, say)
    searcher = make_method(method, refine=budget.refine)
    # The matrices are small: a second BLAS thread only spins, and where processors are shared each
    # decomposition then takes ten times as long.
    with (
        threadpool_limits(1, user_api="blas"),
        keeping_best(best, keep, robot) if keep is not None else contextlib.nullcontext(),
    ):

        def note(p: Progress) -> None:
            best(p)
            if p.stage == BEFORE_SEARCH:
                say(f"{BEFORE_SEARCH}: {p.message}")
            if progress is not None:
                progress(p)

        if checkpoint is None:
            result = searcher.run(problem, budget, rng, note)
        else:
            store = open_checkpoint(checkpoint, resume, problem, searcher, budget, rng)
            result = searcher.run(problem, budget, rng, note, store)
    alarms = (*result.alarms, *latency_alarms(problem, result.latency_s))
    result = dataclasses.replace(result, alarms=alarms)
    if held_out is None:
        return result
    errors = held_out.errors(beside_nominal(result.estimate, result.latency_s))
    provenance = {**result.provenance, "heldout_rmse": errors.to_json()}
    return dataclasses.replace(result, heldout_nrmse=errors.nrmse, provenance=provenance)


def _require_windows(holdout: Sequence[SampledEpisode], window_s: float) -> None:
    """Check before any search that held-out recordings can be judged by.

    Raises:
        InsufficientDataError: None of them holds a window.
    """
    from deal_hw.sim.recordings.episode import fill_gaps
    from deal_hw.sim.recordings.windows import cut_windows

    problem: InsufficientDataError | None = None
    for episode in map(fill_gaps, holdout):
        try:
            cut_windows(episode, max(round(window_s / episode.period_s), 1))
            return
        except InsufficientDataError as err:
            problem = err
    if problem is not None:
        raise InsufficientDataError(f"the held-out recordings are too short: {problem} (--heldout-window)")


def residual_std(words: Sequence[str], robot: RobotModel) -> FloatArray | None:
    """Return what ``--residual-std`` means, positions then velocities, (2 C,); None where it is not given.

    Raises:
        ConfigurationError: It is neither one number nor pairs of a joint and a number above 0.
        UnknownNameError: A joint is not known.
    """
    if not words:
        return None
    if len(words) == 1:
        return residual_std_of(_number(words[0]), robot)
    # A last word without a number is a joint that has none.
    pairs = zip(words[::2], [*map(_number, words[1::2]), *([math.nan] * (len(words) % 2))], strict=True)
    return residual_std_of(dict(pairs), robot)


def residual_std_of(given: float | Mapping[str, float] | None, robot: RobotModel) -> FloatArray | None:
    """Return what a prediction may be off, positions then velocities, (2 C,); None where it is not given.

    Args:
        given: One number for all joints of a fixed robot, or one for each name [rad or m].
        robot: The robot.

    Raises:
        ConfigurationError: A number is missing, or is not above 0.
        UnknownNameError: A joint is not known.
    """
    if given is None:
        return None
    names = robot.description.joint_names + (("orientation", "gyro") if robot.base is not None else ())
    one = not isinstance(given, Mapping)
    values = dict.fromkeys(names, given) if isinstance(given, float | int) else dict(given)
    for name in values:
        if name not in names:
            raise UnknownNameError("joint", name, names)
    if (
        set(values) != set(names)
        or any(math.isnan(v) for v in values.values())
        or (one and robot.base is not None)
    ):
        whole = "" if robot.base is not None else "one number, or "
        raise ConfigurationError(
            f"--residual-std: give {whole}a name and a number for each of {', '.join(names)}"
        )
    for value in values.values():
        Range(1e-9, 1e3, "rad or m").check("--residual-std", float(value))
    C = len(robot.coordinates)
    std = np.ones(2 * C)
    std[:C][robot.joints] = [values[name] for name in robot.description.joint_names]
    if robot.base is not None:
        std[:C][robot.rotation], std[C:][robot.rotation] = values["orientation"], values["gyro"]
    return std


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError as err:
        raise ConfigurationError(f"--residual-std: {word!r} is no number [rad or m]") from err


def finish(
    work: CalibrationInputs,
    result: CalibrationResult,
    folder: Path,
    settings: Mapping[str, Any],
    checkpoint: Path,
    *,
    page: bool = True,
    advise: bool = True,
    threads: int | None = None,
) -> CalibrateReport:
    """Note where a result comes from and write the result folder.

    Args:
        work: What was calibrated.
        result: What was found.
        folder: Where to write.
        settings: What else the provenance says: plain JSON values.
        checkpoint: File of the state to resume from; removed once the results are there.
        page: Write report.html.
        advise: Compute what to record next for parameters that stayed open.
        threads: Simulation threads.

    Raises:
        KeyboardInterrupt: Ctrl-C. It is said whether there are results; where there are, they are whole.
    """
    from deal_hw.calib.report.page import write_result
    from deal_hw.data.files import interrupts_deferred

    with saying_how_to_resume(checkpoint):
        result, report = judged(work, result, settings, page=page, advise=advise, threads=threads)
    try:
        # An impatient Ctrl-C must neither cost an hour's work nor leave half of it.
        with interrupts_deferred():
            files = write_result(folder, work.robot, result, report)
            checkpoint.unlink(missing_ok=True)
            shutil.rmtree(folder / SO_FAR, ignore_errors=True)
    except KeyboardInterrupt:
        aloud(f"\ninterrupted after the end: the results in {folder} are whole")
        raise
    return CalibrateReport(result=result, files=files)


def judged(
    work: CalibrationInputs,
    result: CalibrationResult,
    settings: Mapping[str, Any],
    *,
    page: bool,
    advise: bool,
    threads: int | None,
) -> tuple[CalibrationResult, ReportInputs | None]:
    """Return the result with advice and provenance, and what its report shows."""
    if advise:
        from deal_hw.calib.design.advice import next_recordings

        found = next_recordings(work.robot, result, work.episodes, balance=work.balance, threads=threads)
        result = dataclasses.replace(result, advice=tuple(one.to_json() for one in found))
    names = ("deal-hw", "mujoco", "numpy", "scipy", "torch")
    result = dataclasses.replace(
        result,
        provenance={
            **result.provenance,
            **work.provenance,
            **settings,
            "versions": {name: metadata.version(name) for name in names},
            "processors": len(os.sched_getaffinity(0)),
        },
    )
    if not page:
        return result, None
    from deal_hw.calib.report.gather import gather

    inputs = gather(
        work.robot,
        result,
        work.episodes,
        work.holdout,
        telemetry=work.telemetry,
        window_s=settings.get("heldout_window_s", HELDOUT_WINDOW_S),
        threads=threads,
    )
    return result, inputs
