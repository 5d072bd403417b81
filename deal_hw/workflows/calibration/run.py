"""The steps of every calibration with recordings on the device's grid: search, judge, report, write.

A calibration that is stopped writes its best fit so far, and keeps the state from which it can continue.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw import findings
from deal_hw.calib.pipeline.methods import (
    CLOSED_LOOP_METHODS,
    make_method,
    search_of,
    takes_engine,
    with_rates,
)
from deal_hw.calibration import (
    EXPLAINED_CHI2,
    LATENCY,
    Z90,
    CalibrationMethod,
    CalibrationResult,
    ProgressCallback,
)
from deal_hw.errors import (
    DatasetError,
    DealHwError,
    InsufficientDataError,
    ModelNotWrittenError,
)
from deal_hw.findings import Finding, SafeChecks
from deal_hw.parameters import ParameterSpace
from deal_hw.scale.tasks import task_map
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import CalibrationInput, extra
from deal_hw.workflows.calibration.result_folder import (
    HELD_OUT,
    BestSoFar,
    ResultFolder,
    UnfinishedCalibrationError,
    unfinished,
)
from deal_hw.workflows.calibration.settings import HELDOUT_WINDOW_S, CalibrateSettings
from deal_hw.workflows.say import Say, silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calib.report.gather import ReportInputs
    from deal_hw.calib.validation.metrics import HeldOut, HeldoutErrors
    from deal_hw.sim.engine.gpu import EngineName
    from deal_hw.sim.recordings.episode import SampledEpisode


@dataclass(frozen=True, kw_only=True)
class CalibrateReport:
    """What a calibration wrote.

    Attributes:
        result: The result.
        files: The files by name.
        problem: Why there are fewer files than usual; None if there are all.
    """

    result: CalibrationResult
    files: dict[str, Path]
    problem: DealHwError | None = None

    @property
    def exit_code(self) -> int:
        """For the shell: 0, or 1 if the checks of the result were not made."""
        return int(self.result.unchecked)


def calibrate_input(
    settings: CalibrateSettings,
    work: CalibrationInput,
    method: str,
    *,
    progress: ProgressCallback | None = None,
    say: Say = silent,
    results: ResultFolder | None = None,
) -> CalibrationResult:
    """Calibrate with the settings; see :func:`calibrate_or_raise`.

    What raises after a fit costs no fit, an hour's work: it is named, and the fit is the result.
    """
    try:
        return calibrate_or_raise(settings, work, method, progress=progress, say=say, results=results)
    except UnfinishedCalibrationError as err:
        return err.result


@extra("calib")
def calibrate_or_raise(
    settings: CalibrateSettings,
    work: CalibrationInput,
    method: str,
    *,
    progress: ProgressCallback | None = None,
    say: Say = silent,
    results: ResultFolder | None = None,
) -> CalibrationResult:
    """Calibrate from recordings on the device's time grid, without writing results.

    Args:
        settings: How to search and to judge. What they say of files and of the space is in the input already.
        work: Robot, parameters and recordings.
        method: Name of the method, by default that of
            :func:`~deal_hw.workflows.calibration.intake.usual_method`.
        progress: Called with the progress.
        say: Called with a sentence on each better fit, and on its file.
        results: Folder for the state after each generation, and on Ctrl-C for the best fit so far; None:
            nothing is written.

    Raises:
        ConfigurationError: A setting cannot be used with this robot or these recordings.
        InsufficientDataError: The recordings are too short, or do not show what is asked for.
        UnfinishedCalibrationError: Something raised after the first fit; the error has that fit.
    """
    from deal_hw.calib.validation.metrics import HeldOut

    _require_windows(work.holdout, settings.heldout_window)
    problem = _problem(settings, work, method, say)
    if problem.rates > 1:
        method = with_rates(method)
    window_s, threads = settings.heldout_window, settings.threads
    held_out = HeldOut(work.robot, work.space, work.holdout, window_s, threads) if work.holdout else None

    def judge(theta: FloatArray, latency: float, of: ParameterSpace) -> Mapping[str, float]:
        return {} if held_out is None else _errors(held_out.of(of), theta, latency).nrmse

    keeps: dict[str, Any] = {}
    if results is not None:
        if not results.resume:
            results.clear_so_far()
        keeps = {"keep": partial(results.keep, work.robot), "next_step": lambda: results.next_step}
    best = BestSoFar(work.space, judge, say, progress, **keeps)
    thorough = settings.checks == "all"
    searcher = make_method(method, refine=settings.budget.refine, thorough=thorough, laws=settings.laws)
    result = _searched(problem, searcher, settings, best, results)
    return _checked(problem, result, settings, method, held_out)


def _problem(settings: CalibrateSettings, work: CalibrationInput, method: str, say: Say) -> Problem:
    """Return the calibration problem, checked, with the engine and the start states of the method."""
    from deal_hw.calib.data.checks import check_delays, target_changes
    from deal_hw.calib.data.effort_checks import check_efforts
    from deal_hw.calib.data.noise import SMOOTHING_S
    from deal_hw.calib.data.problem import Problem

    latency_s = settings.latency
    if latency_s is None and not target_changes(work.episodes):
        latency_s = 0.0
        say("no command ever changes, so the recordings do not show the latency: it is taken as 0")
    engine: EngineName = "mujoco"
    if settings.engine != "mujoco":
        from deal_hw.sim.engine.warp_support import choose_engine

        without, members = "" if takes_engine(method) else method, settings.budget.population
        engine = choose_engine(settings.engine, work.robot, members, "the search", say, without, work.space)
    problem = Problem(
        work.robot,
        work.space,
        work.episodes,
        threads=settings.threads,
        latency_range_s=settings.latency_range,
        fixed_latency_s=latency_s,
        known_std=work.known_std,
        smoothing_s=SMOOTHING_S if work.smoothing_s is None else work.smoothing_s,
        policy=work.policy,
        tasks=task_map(settings.ray),
        engine=engine,
        guessed=work.guessed,
    )
    check_delays(problem)
    check_efforts(problem)
    if _in_loop(problem, method):
        from deal_hw.workflows.calibration.starts import chosen_starts

        std = chosen_starts(problem, settings.starts, dict(settings.start_std), say)
        problem = problem.sharing(start_std=std)
    return problem


def _in_loop(problem: Problem, method: str) -> bool:
    """Return whether the method runs the policy that moved the robot, which is known."""
    return problem.policy is not None and search_of(method) in CLOSED_LOOP_METHODS


def _searched(
    problem: Problem,
    searcher: CalibrationMethod[Problem],
    settings: CalibrateSettings,
    best: BestSoFar,
    results: ResultFolder | None,
) -> CalibrationResult:
    """Run the method; Ctrl-C writes the best fit so far."""
    from threadpoolctl import threadpool_limits

    from deal_hw.calib.data.resume import SearchCheckpoint, run_identity

    budget, rng = settings.budget, np.random.default_rng(settings.seed)
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
                results.write(problem.robot, best.ended("was stopped"), stopped=True)
                to_stderr(f"\nbest so far: {best.sentence}; written to {results.so_far}, not checked")
            raise
        except Exception as err:
            if best.result is None or err is best.raised:
                raise
            how = f"ended by an error, {findings.reason_of(err)}"
            ended = best.ended(how, "Report this error.")
            raise UnfinishedCalibrationError(f"the calibration {how}", ended) from err
        best.take(result)
    return result


def _checked(
    problem: Problem,
    result: CalibrationResult,
    settings: CalibrateSettings,
    method: str,
    held_out: HeldOut | None,
) -> CalibrationResult:
    """Return the result with the alarm on its latency, its start states and its held-out errors."""
    from deal_hw.calib.validation.checks import latency_alarms
    from deal_hw.workflows.calibration.late_commands import late_commands

    safely, provenance = SafeChecks(), result.provenance
    first, last = provenance.get("grown_ranges", {}).get(LATENCY, problem.latency_range_s)
    more = safely.run("the latency's range", (), latency_alarms, problem, result.latency_s, (first, last))
    if not _in_loop(problem, method):
        more += safely.run("the rows of the commands", (), late_commands, problem, result)
    else:
        provenance = {
            **provenance,
            "start_states": "recorded" if problem.start_std is None else "drawn",
            "start_std": dict(settings.start_std),
        }
    result = dataclasses.replace(result, alarms=(*result.alarms, *more), provenance=provenance)
    if held_out is not None:
        result = safely.run(HELD_OUT, result, _with_errors, result, held_out)
    return result.with_failed(safely)


def _errors(of: HeldOut, theta: FloatArray, latency_s: float) -> HeldoutErrors:
    nominal = of.space.nominal, of.problem.robot.latency_s
    return of.errors({"nominal": nominal, "calibrated": (theta, latency_s)})


def _with_errors(result: CalibrationResult, held_out: HeldOut) -> CalibrationResult:
    """Return a result with its held-out errors."""
    # Laws and zeros of single recordings became parameters.
    found = _errors(held_out.of(result.space), result.estimate, result.latency_s)
    provenance = {**result.provenance, "heldout_rmse": found.to_json()}
    result = dataclasses.replace(result, heldout_nrmse=found.nrmse, provenance=provenance)
    return _held_to_the_noise(result, held_out.of(result.space))


def _held_to_the_noise(result: CalibrationResult, held_out: HeldOut) -> CalibrationResult:
    """Return a result that explains its recordings, with an alarm if it does not explain held-out motion."""
    problem = held_out.problem
    if (
        result.alarms
        or not result.chi2 <= EXPLAINED_CHI2
        or problem.robot.base is not None
        or problem.noise_free
    ):
        return result
    chi2, chance = held_out.chi2(result.estimate, result.latency_s)
    alarms = []
    if chi2 > EXPLAINED_CHI2 * max(result.chi2, 1.0) * (1 + Z90 * chance):
        alarms.append(
            Finding.alarm(
                f"On held-out motion the error is {math.sqrt(chi2):.1f} times the sensor's noise, on fitted "
                f"motion {math.sqrt(result.chi2):.1f} times.",
                "The held-out motion does what the fitted recordings do not show, such as a faster motion, "
                "or an effort limit that is reached.",
                "Fit it, too (--data), and hold other motion out. Or record the motion that is advised.",
            )
        )
    provenance = {**result.provenance, "heldout_chi2": chi2}
    return dataclasses.replace(result, alarms=tuple(alarms), provenance=provenance)


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
        try:
            judgement = judged(work, result, settings, page=page, advise=advise, threads=threads)
        except KeyboardInterrupt:
            how = "was stopped after its fit, before advice and report"
            results.write(work.robot, unfinished(result, how, results.next_step), stopped=True)
            to_stderr(f"\nthe fit is written to {results.so_far}")
            raise
    result, report = judgement
    try:
        return _written(work, result, results, report)
    except KeyboardInterrupt:
        to_stderr(
            f"\ninterrupted after the end of the calibration: the results in {results.path} are complete"
        )
        raise


def _written(
    work: CalibrationInput, result: CalibrationResult, results: ResultFolder, report: ReportInputs | None
) -> CalibrateReport:
    """Write the result; without the report if that cannot be made."""
    safely = SafeChecks()
    for shown in (report, None) if report is not None else (None,):
        found = result.with_failed(safely)
        try:
            return CalibrateReport(result=found, files=results.write(work.robot, found, shown))
        except ModelNotWrittenError as err:
            return CalibrateReport(result=found, files=err.files, problem=err)
        except DatasetError as err:
            return CalibrateReport(result=found, files={}, problem=err)
        except Exception as err:
            if shown is None:
                raise
            safely.failed["the report"] = findings.reason_of(err)
    raise RuntimeError("unreachable: the last attempt returns or raises")


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
    """Return the result with advice and provenance, and the contents of its report.

    Each is computed of a result that is there already: what cannot be is named, and the result stands.
    """
    from deal_hw.sim.plain_model import FACTS

    safely = SafeChecks()
    if advise:
        from deal_hw.calib.design.advice import next_recordings

        found = safely.run(
            "the next recording",
            (),
            next_recordings,
            work.robot,
            result,
            work.episodes,
            balance=work.balance,
            threads=threads,
        )
        result = dataclasses.replace(result, advice=tuple(one.to_json() for one in found))
    names = ("deal-hw", "mujoco", "numpy", "scipy", "torch")
    without = {FACTS: {"error": "it could not be made"}}
    result = dataclasses.replace(
        result,
        provenance={
            **result.provenance,
            **work.provenance,
            **settings,
            **safely.run("the model for MuJoCo alone", without, plain_model, work, result),
            "versions": {name: metadata.version(name) for name in names},
            "processors": len(os.sched_getaffinity(0)),
        },
    )
    if not page:
        return result.with_failed(safely), None
    from deal_hw.calib.report.gather import gather

    shown = result.with_failed(safely)
    inputs = safely.run(
        "the report",
        None,
        gather,
        work.robot,
        shown,
        work.episodes,
        work.holdout,
        telemetry=work.telemetry,
        window_s=settings.get("heldout_window_s", HELDOUT_WINDOW_S),
        threads=threads,
    )
    return (shown if inputs is not None else result.with_failed(safely)), inputs
