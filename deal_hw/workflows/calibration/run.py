"""The steps of every calibration with recordings on the device's grid: search, judge, report, write.

A calibration that is stopped writes its best fit so far, and keeps the state from which it can continue.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from deal_hw.calibration import (
    BEFORE_SEARCH,
    LATENCY,
    LATENCY_RANGE_S,
    Budget,
    CalibrationResult,
    Progress,
    ProgressCallback,
    percent,
)
from deal_hw.errors import ConfigurationError, InsufficientDataError, MissingExtraError
from deal_hw.findings import Finding
from deal_hw.parameters import ParameterSpace
from deal_hw.scale.tasks import task_map
from deal_hw.task_map import InThisProcess, TaskMap
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.settings import HELDOUT_WINDOW_S, CalibrateSettings
from deal_hw.workflows.say import Say, silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import PopulationPolicy
    from deal_hw.calib.report.gather import ReportInputs
    from deal_hw.calib.validation.metrics import HeldoutErrors
    from deal_hw.sim.engine.gpu import WantedEngine
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.episode import SampledEpisode
    from deal_hw.workflows.calibration.intake import CalibrationInput


CHECKPOINT = "checkpoint.npz"
SO_FAR = "so_far"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultFolder:
    """The folder of a calibration: its state while it runs, then its results.

    Attributes:
        path: The folder.
        resume: Continue from the state that a stopped calibration has left there.

    Raises:
        ConfigurationError: There is no such state.
    """

    path: Path
    resume: bool = False

    def __post_init__(self) -> None:
        if self.resume and not self.checkpoint.exists():
            raise ConfigurationError(
                f"nothing to resume: {self.checkpoint} does not exist; leave --resume out to begin a "
                "calibration"
            )

    @property
    def checkpoint(self) -> Path:
        """File of the state; removed when the results are written."""
        return self.path / CHECKPOINT

    @property
    def so_far(self) -> Path:
        """Folder of the best fit of a stopped calibration; removed when the results are written."""
        return self.path / SO_FAR

    def write(
        self,
        robot: RobotModel,
        result: CalibrationResult,
        report: ReportInputs | None = None,
        *,
        stopped: bool = False,
    ) -> dict[str, Path]:
        """Write a result and return its files by name. A Ctrl-C takes effect after the last file.

        Args:
            robot: The robot.
            result: The result.
            report: Contents of report.html; None: it is not written.
            stopped: It is the best fit of a stopped calibration: the state to resume from stays.

        Raises:
            KeyboardInterrupt: Ctrl-C; the files are complete.
        """
        from deal_hw.calib.report.page import write_result
        from deal_hw.data.files import interrupts_deferred

        # A Ctrl-C here must neither lose an hour's work nor leave half of the files.
        with interrupts_deferred():
            files = write_result(self.so_far if stopped else self.path, robot, result, report)
            if not stopped:
                self.checkpoint.unlink(missing_ok=True)
                shutil.rmtree(self.so_far, ignore_errors=True)
        return files

    @contextlib.contextmanager
    def resumable(self) -> Iterator[None]:
        """On Ctrl-C say where the state is and how to continue, and raise the interrupt again."""
        try:
            yield
        except KeyboardInterrupt:
            if self.checkpoint.exists():
                to_stderr(
                    f"\ncalibration stopped; its state is in {self.checkpoint}. The same command with "
                    "--resume continues, to the same result"
                )
            else:
                to_stderr(
                    "\ncalibration stopped before the search; there is no state to --resume, begin again"
                )
            raise


@dataclass(frozen=True, kw_only=True)
class CalibrateReport:
    """What a calibration wrote.

    Attributes:
        result: The result.
        files: The files by name.
    """

    result: CalibrationResult
    files: dict[str, Path]


class BestSoFar:
    """Receives the progress of a calibration: keeps the best fit for an interrupt, and reports clear gains.

    Args:
        space: The parameters.
        judge: Returns the held-out errors of a fit, (K,) and latency [s] with its parameters, as
            "calibrated", beside "nominal" and "null"; None without held-out data.
        say: Called with a sentence on each fit whose error is 5 % lower than the one reported before, and
            with each message before the search.
        progress: Called with the progress, too; None: nobody else is.
    """

    def __init__(
        self,
        space: ParameterSpace,
        judge: Callable[[FloatArray, float, ParameterSpace], Mapping[str, float]] | None,
        say: Say = silent,
        progress: ProgressCallback | None = None,
    ) -> None:
        self._space, self._judge, self._say, self._progress = space, judge, say, progress
        self._began = time.monotonic()
        self._error = self._said = math.inf
        self.result: CalibrationResult | None = None

    def __call__(self, progress: Progress) -> None:
        """Note a step of the calibration."""
        if progress.estimate is not None:
            self._compare(progress, progress.estimate)
        if progress.stage == BEFORE_SEARCH:
            self._say(f"{BEFORE_SEARCH}: {progress.message}")
        if self._progress is not None:
            self._progress(progress)

    def _compare(self, progress: Progress, estimate: FloatArray) -> None:
        """Compare a fit with the best one so far."""
        latency_s = progress.latency_s or 0.0
        space = progress.space or self._space
        errors = self._judge(estimate, latency_s, space) if self._judge is not None else {}
        error = errors.get("calibrated", progress.values.get("chi2", math.inf))
        if self.result is not None and not error < self._error:
            return
        self._error = error
        space = space.holding(estimate)
        low_high = np.stack([space.low, space.high], axis=1)
        self.result = CalibrationResult(
            method=f"interrupted after {progress.stage}",
            space=space,
            estimate=estimate,
            interval=low_high,
            latency_s=latency_s,
            latency_interval_s=(latency_s, latency_s),
            chi2=progress.values.get("chi2", math.nan),
            heldout_nrmse=errors,
            alarms=(
                Finding.alarm(
                    f"The calibration was interrupted after {progress.stage}, "
                    f"{time.monotonic() - self._began:.0f} s.",
                    "No interval was computed; the given ones are the search ranges.",
                    "Run the same command with --resume to continue.",
                ),
            ),
        )
        if self._error > 0.95 * self._said:
            return
        self._said = self._error
        self._say(f"{time.monotonic() - self._began:.0f} s, {progress.stage}: {self.sentence}")

    @property
    def sentence(self) -> str:
        """Error of the best fit, as a sentence."""
        if self.result is None:
            return "no fit yet"
        errors = self.result.heldout_nrmse
        if errors:
            return (
                f"held-out error {percent(errors['calibrated'])} of the signal's range "
                f"(your own model: {percent(errors['nominal'])})"
            )
        return f"residuals {math.sqrt(max(self.result.chi2, 0.0)):.2g} times the sensor's noise"


def calibrate_input(
    settings: CalibrateSettings,
    work: CalibrationInput,
    method: str,
    *,
    progress: ProgressCallback | None = None,
    say: Say = silent,
    results: ResultFolder | None = None,
) -> CalibrationResult:
    """Calibrate with the settings; see :func:`calibrate_episodes`."""
    return calibrate_episodes(
        work.robot,
        work.space,
        work.episodes,
        work.holdout,
        method=method,
        budget=settings.budget,
        thorough=settings.checks == "all",
        laws=settings.laws,
        rng=np.random.default_rng(settings.seed),
        latency_s=settings.latency,
        latency_range_s=settings.latency_range,
        threads=settings.threads,
        progress=progress,
        say=say,
        results=results,
        known_std=work.known_std,
        heldout_window_s=settings.heldout_window,
        policy=work.policy,
        smoothing_s=work.smoothing_s,
        starts=settings.starts,
        start_std=dict(settings.start_std),
        tasks=task_map(settings.ray),
        engine=settings.engine,
        guessed=work.guessed,
    )


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
    results: ResultFolder | None = None,
    known_std: FloatArray | None = None,
    heldout_window_s: float = HELDOUT_WINDOW_S,
    smoothing_s: float | None = None,
    policy: PopulationPolicy | None = None,
    starts: Literal["recorded", "drawn"] | None = "recorded",
    start_std: Mapping[str, float] | None = None,
    thorough: bool = False,
    tasks: TaskMap | None = None,
    laws: bool = True,
    engine: WantedEngine = "mujoco",
    guessed: tuple[str, ...] = (),
) -> CalibrationResult:
    """Calibrate from recordings on the device's time grid, without writing results.

    Args:
        robot: The nominal model.
        space: The parameters to search.
        episodes: Recordings to fit.
        holdout: Recordings that only test the result; the search never uses them.
        method: Name of the method.
        budget: How much it may use.
        rng: The only source of randomness.
        latency_s: Total latency if it is known [s].
        latency_range_s: Otherwise the range of its search [s].
        threads: Simulation threads.
        progress: Called with the progress.
        say: Called with a sentence on each better fit, and on its file.
        results: Folder for the state after each generation, and on Ctrl-C for the best fit so far; None:
            nothing is written.
        known_std: Standard deviation of the prediction error, positions then velocities, (2 C,); None: the
        sensor noise, estimated from the recordings.
        heldout_window_s: Held-out predictions restart from the measured state after this time [s].
        smoothing_s: Time over which start states are smoothed [s]; None for the default.
        policy: The policy that moved the robot all the time, for methods that need it.
        starts: Where rollouts of the policy begin: in the recorded first state, or in drawn states; None:
            drawn ones where the recordings do not show the first state well.
        start_std: Standard deviation of entries of drawn start states, by name; others have the recordings'
            own.
        thorough: Run checks to their end where they take more physics steps than the fits.
        tasks: Does fits that do not depend on each other; None: this process.
        laws: Take a law that the model lacks where it predicts better.
        engine: What simulates the population of a search.
        guessed: Names of the parameters whose range nobody chose; see
            :mod:`deal_hw.calib.pipeline.wider_ranges`.
    """
    try:
        from threadpoolctl import threadpool_limits

        from deal_hw.calib.data.checks import check_delays, target_changes
        from deal_hw.calib.data.effort_checks import check_efforts
        from deal_hw.calib.data.noise import SMOOTHING_S
        from deal_hw.calib.data.problem import Problem
        from deal_hw.calib.data.resume import SearchCheckpoint, run_identity
        from deal_hw.calib.pipeline.methods import (
            CLOSED_LOOP_METHODS,
            make_method,
            search_of,
            takes_engine,
        )
        from deal_hw.calib.validation.metrics import HeldOut
    except ModuleNotFoundError as err:
        raise MissingExtraError(str(err.name), "calib") from err

    _require_windows(holdout, heldout_window_s)
    if latency_s is None and not target_changes(episodes):
        latency_s = 0.0
        say("no command ever changes, so the recordings do not show the latency: it is taken as 0")
    problem = Problem(
        robot,
        space,
        episodes,
        threads=threads,
        latency_range_s=latency_range_s,
        fixed_latency_s=latency_s,
        known_std=known_std,
        smoothing_s=SMOOTHING_S if smoothing_s is None else smoothing_s,
        policy=policy,
        tasks=tasks or InThisProcess(),
        guessed=guessed,
    )
    if engine != "mujoco":
        from deal_hw.sim.engine.warp_support import choose_engine

        without = "" if takes_engine(method) else method
        problem.engine = choose_engine(engine, robot, budget.population, "the search", say, without, space)
    check_delays(problem)
    check_efforts(problem)
    in_loop = policy is not None and search_of(method) in CLOSED_LOOP_METHODS
    if in_loop:
        from deal_hw.workflows.calibration.starts import chosen_starts

        problem.start_std = chosen_starts(problem, starts, start_std or {}, say)

    held_out = HeldOut(robot, space, holdout, heldout_window_s, threads) if holdout else None

    def errors(of: HeldOut, theta: FloatArray, latency: float) -> HeldoutErrors:
        return of.errors({"nominal": (of.space.nominal, 0.0), "calibrated": (theta, latency)})

    def judge(theta: FloatArray, latency: float, of: ParameterSpace) -> Mapping[str, float]:
        return {} if held_out is None else errors(held_out.of(of), theta, latency).nrmse

    best = BestSoFar(space, judge, say, progress)
    searcher = make_method(method, refine=budget.refine, thorough=thorough, laws=laws)
    # The matrices are small: a second BLAS thread only spins, and on shared processors each decomposition
    # then takes ten times as long.
    with threadpool_limits(1, user_api="blas"), problem.tasks:
        store = None
        if results is not None:
            identity = run_identity(problem, searcher, budget, rng)
            store = SearchCheckpoint(results.checkpoint, identity, fresh=not results.resume)
        try:
            result = searcher.run(problem, budget, rng, best, store)
        except KeyboardInterrupt:
            if results is not None and best.result is not None:
                results.write(robot, best.result, stopped=True)
                to_stderr(f"\nbest so far: {best.sentence}; written to {results.so_far}, without intervals")
            raise
    from deal_hw.calib.validation.checks import latency_alarms

    provenance = result.provenance
    first, last = provenance.get("grown_ranges", {}).get(LATENCY, problem.latency_range_s)
    alarms = (*result.alarms, *latency_alarms(problem, result.latency_s, (first, last)))
    if in_loop:
        provenance = {
            **provenance,
            "start_states": "recorded" if problem.start_std is None else "drawn",
            "start_std": dict(start_std or {}),
        }
    result = dataclasses.replace(result, alarms=alarms, provenance=provenance)
    if held_out is None:
        return result
    # Laws and zeros of single recordings became parameters.
    found = errors(held_out.of(result.space), result.estimate, result.latency_s)
    provenance = {**result.provenance, "heldout_rmse": found.to_json()}
    return dataclasses.replace(result, heldout_nrmse=found.nrmse, provenance=provenance)


def _require_windows(holdout: Sequence[SampledEpisode], window_s: float) -> None:
    """Check before any search that the held-out recordings are long enough.

    Raises:
        InsufficientDataError: None of them contains a window.
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


def finish(
    work: CalibrationInput,
    result: CalibrationResult,
    results: ResultFolder,
    settings: Mapping[str, Any],
    *,
    page: bool = True,
    advise: bool = True,
    threads: int | None = None,
) -> CalibrateReport:
    """Add a result's provenance and write the result folder.

    Args:
        work: The inputs.
        result: The result.
        results: Where to write.
        settings: More provenance: plain JSON values.
        page: Write report.html.
        advise: Compute which motion to record next for weak parameters.
        threads: Simulation threads.

    Raises:
        KeyboardInterrupt: Ctrl-C. A message says whether there are results; if so, they are complete.
    """
    with results.resumable():
        result, report = judged(work, result, settings, page=page, advise=advise, threads=threads)
    try:
        files = results.write(work.robot, result, report)
    except KeyboardInterrupt:
        to_stderr(
            f"\ninterrupted after the end of the calibration: the results in {results.path} are complete"
        )
        raise
    return CalibrateReport(result=result, files=files)


def plain_model(work: CalibrationInput, result: CalibrationResult) -> dict[str, Any]:
    """Return the provenance of the calibrated model for MuJoCo alone: what it has, and how near it is."""
    from deal_hw.calib.report.page import write_model
    from deal_hw.sim.plain_model import FACTS, plain_facts

    episodes = (*work.episodes, *work.holdout)
    return {FACTS: plain_facts(work.robot, partial(write_model, work.robot, result), episodes)}


def judged(
    work: CalibrationInput,
    result: CalibrationResult,
    settings: Mapping[str, Any],
    *,
    page: bool,
    advise: bool,
    threads: int | None,
) -> tuple[CalibrationResult, ReportInputs | None]:
    """Return the result with advice and provenance, and the contents of its report."""
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
            **plain_model(work, result),
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
