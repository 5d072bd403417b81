"""The real bench: methods on recordings of a real robot, compared on held-out motion.

There is no truth, so a row has held-out errors instead of parameter errors. All methods get the same
recordings, parameters, ranges and budget. The searches' expected residual, unless given, is fitted once, on
the fitted recordings.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from deal_hw.bench.figures import draw
from deal_hw.bench.rows import Cells, RowTable, noted_in
from deal_hw.bench.settings import Real
from deal_hw.bench.tables import line, print_real
from deal_hw.calib.pipeline.methods import check_method, divided, is_default
from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import CalibrationInput, calibration_input
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import (
    HELDOUT_PART,
    CalibrateSettings,
    DatasetSettings,
    FilesSettings,
    Recordings,
    UserRobotSettings,
    python_kinds,
)
from deal_hw.workflows.say import silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.sim.engine.gpu import EngineName

KEY = ("task", "split", "method", "refined", "range_ratio", "seed", "engine")
UNTOLD = frozenset({"nominal", "output-error", "output-error-no-laws"})
"""Pipelines that need no expected prediction error."""


def source_of(settings: Real) -> CalibrateSettings:
    """Return the settings of a calibration that reads the recordings as ``deal-hw calibrate`` does.

    Raises:
        ConfigurationError: No recordings were named, or both.
        UnknownNameError: A setting does not apply to such recordings.
    """
    recordings = settings.recordings
    if recordings.model is None and settings.dataset is None:
        raise ConfigurationError(
            "bench real needs --model robot.xml --data rec.csv ... or --dataset DIR, and --holdout other.csv "
            "(of a dataset episodes) or a part of each recording (--holdout-part)"
        )
    named = {} if settings.dataset is None else {"dataset": settings.dataset}
    for entry in dataclasses.fields(Recordings):
        value = getattr(recordings, entry.name)
        if value != entry.default:
            named[entry.name] = value
    source: CalibrateSettings = python_kinds().make(
        "bench real",
        **named,
        holdout=tuple(int(str(one)) if str(one).isdigit() else one for one in settings.holdout),
        heldout_window=settings.heldout_window,
        residual_std=settings.residual_std,
        # A file of parameters has ranges of its own.
        range_ratio=settings.range_ratio if recordings.parameters is None else None,
        threads=settings.threads,
    )
    return source


def prepare(source: CalibrateSettings, *, quiet: bool = False) -> CalibrationInput:
    """Read and check recordings and parameters once for all cells.

    Args:
        source: Model and recordings, or a dataset, and the held-out part.
        quiet: Print nothing.

    Raises:
        ConfigurationError: A setting cannot be used.
        DatasetError: A recording cannot be used.
    """
    return calibration_input(source, say=silent if quiet else to_stderr)


def split_name(source: CalibrateSettings) -> str:
    """Return the name of the held-out part."""
    judges: tuple[Any, ...] = ()
    if isinstance(source, DatasetSettings | FilesSettings):
        judges = source.holdout
    if judges:
        return "+".join(Path(str(one)).stem for one in judges)
    part = source.holdout_part if isinstance(source, UserRobotSettings) else None
    share = HELDOUT_PART if part is None else part
    return f"last {share:.0%}"


def expected_std(
    work: CalibrationInput, given: FloatArray | None, threads: int | None
) -> Callable[[str], FloatArray | None]:
    """Return a method's expected prediction error, (2 C,): the given one, or a first fit's."""
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calib.fit.output_error import SHORT, fit_output_error

    @functools.cache
    def fitted() -> FloatArray:
        """Fit short windows from the nominal values once, before the first cell that needs it."""
        problem = Problem(work.robot, work.space, work.episodes, threads=threads)
        return fit_output_error(problem, work.space.nominal, problem.first_latency_s, SHORT).expected_std

    def std(method: str) -> FloatArray | None:
        return given if given is not None or divided(method)[0] in UNTOLD else fitted()

    return std


def table(settings: Real) -> RowTable:
    """Read and check the recordings and return the bench: its cells by :func:`run_cell`.

    Raises:
        UnknownNameError: There is no such method.
        ConfigurationError: No model was named, or a setting cannot be used.
        DatasetError: A recording cannot be used.
    """
    for method in settings.methods:
        check_method(method)
    source = source_of(settings)
    work = prepare(source, quiet=settings.quiet)
    task = Path(source.model).stem if isinstance(source, FilesSettings) else work.robot.description.name
    split, expected = split_name(source), expected_std(work, work.known_std, settings.threads)
    run = partial(
        run_cell,
        work,
        task,
        split,
        expected=expected,
        threads=settings.cell_threads,
        budget=settings.budget,
        window_s=settings.heldout_window,
    )
    args = []
    for seed, method in itertools.product(settings.seeds, settings.methods):
        refined, engine = is_default(method) or settings.refine_all, settings.engine_of(method)
        cell = (method, refined, settings.range_ratio, seed, engine)
        args.append(((task, split, *cell), cell))
    cells = Cells(names=KEY, run=run, args=args, tasks=settings.tasks(), bench=settings.name)
    return RowTable(cells=cells, line=line, summary=print_real, draw=draw)


def run_cell(
    work: CalibrationInput,
    task: str,
    split: str,
    method: str,
    refine: bool,
    range_ratio: float,
    seed: int,
    engine: EngineName | Literal[""] = "",
    *,
    expected: Callable[[str], FloatArray | None],
    budget: Budget,
    window_s: float,
    threads: int | None,
) -> dict[str, Any]:
    """Calibrate with one method and judge it on held-out motion; an error goes into the row.

    Args:
        work: The prepared inputs.
        task: Name of the robot in the row.
        split: Name of the held-out part.
        method: Name of the method.
        refine: Whether the refinement follows.
        range_ratio: Ratio of the search range, for the row.
        seed: Seed of everything random.
        engine: What simulates the population of a search; "" for mujoco.
        expected: Returns a method's expected prediction error, (2 C,); None: the sensor noise, or the
            method's own estimate.
        budget: Limits of the search.
        window_s: Length of held-out predictions [s].
        threads: Simulation threads.
    """
    row: dict[str, Any] = {
        "bench": "real",
        "task": task,
        "split": split,
        "profile": "real",
        "method": method,
        "refined": refine,
        "range_ratio": range_ratio,
        "seed": seed,
        "engine": engine,
        "error": "",
    }
    with noted_in(row):
        settings = CalibrateSettings(
            method=method,
            population=budget.population,
            generations=budget.generations,
            refine=refine,
            seed=seed,
            threads=threads,
            heldout_window=window_s,
            # An uncalibrated model has no latency.
            latency=0.0 if method == "nominal" else None,
            engine=engine or "mujoco",
        )
        # Methods are compared in the ranges that the row names.
        compared = dataclasses.replace(work, known_std=expected(method), guessed=())
        result = calibrate_or_raise(settings, compared, method)
        row |= result_part(result, window_s)
    return row


def result_part(result: CalibrationResult, window_s: float) -> dict[str, Any]:
    """Return a result's part of the row; its held-out predictions restart after ``window_s`` [s]."""
    unit = result.space.normalize(result.estimate)
    rmse = result.provenance.get("heldout_rmse", {})
    row: dict[str, Any] = {f"heldout_nrmse_{name}": value for name, value in result.heldout_nrmse.items()}
    row |= {f"heldout_rmse_{name}": value for name, value in rmse.get("mean", {}).items()}
    row |= {f"heldout_pooled_{name}": value for name, value in rmse.get("pooled", {}).items()}
    row |= {
        "heldout_window_s": window_s,
        "latency_found": result.latency_s,
        "steps": result.steps,
        "seconds": result.seconds,
        "flagged": bool(result.alarms),
        "alarms": [str(alarm) for alarm in result.alarms],
        "chi2": result.chi2,
        "at_bound": [
            name for name, u in zip(result.space.names, unit, strict=True) if u < 1e-6 or u > 1 - 1e-6
        ],
        "null_directions": list(result.null_directions),
        **{
            name: result.provenance.get(name)
            for name in ("laws", "cross_validation", "split_half", "confounded", "heldout_rmse")
        },
        "estimate": dict(zip(result.space.names, map(float, result.estimate), strict=True)),
    }
    return row
