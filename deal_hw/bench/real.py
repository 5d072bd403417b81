"""The real bench: methods against each other on recordings of a real robot, judged on held-out motion.

There is no truth, so a row has held-out errors instead of parameter errors. All methods get the same
recordings, parameters, ranges and budget. What the searches may expect of a residual is fitted once, to the
recordings that are fitted, unless it is given.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.bench.rows import Cells, Row
from deal_hw.calib.methods import check_method
from deal_hw.calibration import Budget
from deal_hw.errors import ConfigurationError, DealHwError
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.model import HELDOUT_PART, Recordings, prepare_model
from deal_hw.workflows.calibration.run import (
    CalibrationInputs,
    SpaceOverrides,
    calibrate_episodes,
    residual_std,
)
from deal_hw.workflows.say import aloud, silent

KEY = ("task", "split", "method", "refined", "range_ratio", "seed")
METHODS = ("nominal", "output-error", "eki", "mujoco-sysid", "least-squares-multistart")
"""Rows where nothing else is asked for."""

UNTOLD = frozenset({"nominal", "output-error"})
"""Methods that need not be told what a prediction may be off."""


def prepare(
    recordings: Recordings,
    holdout: Sequence[Path],
    range_ratio: float | None,
    std: Sequence[str],
    *,
    threads: int | None,
    quiet: bool,
) -> CalibrationInputs:
    """Read and check model, recordings and parameters once for all cells.

    Raises:
        ConfigurationError: No model was named, or a setting cannot be used.
        DatasetError: A recording cannot be used.
    """
    if recordings.model is None:
        raise ConfigurationError(
            "bench real needs --model robot.xml --data rec.csv ... (docs/tutorials/your-robot.md), and "
            "--holdout other.csv or a part of each recording (--holdout-part)"
        )
    overrides = SpaceOverrides(free=(), known={}, ranges=(), range_ratio=range_ratio)
    return prepare_model(
        recordings,
        holdout,
        overrides,
        std=lambda robot: residual_std(std, robot),
        threads=threads,
        say=silent if quiet else aloud,
    )


def split_name(recordings: Recordings, holdout: Sequence[Path]) -> str:
    """Return what is held out, in a word or two."""
    if holdout:
        return "+".join(path.stem for path in holdout)
    share = HELDOUT_PART if recordings.holdout_part is None else recordings.holdout_part
    return f"last {share:.0%}"


def expected_std(
    work: CalibrationInputs, words: Sequence[str], threads: int | None
) -> Callable[[str], FloatArray | None]:
    """Return what tells a method what a prediction may be off, (2 C,): as it is given, or a first fit's."""
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calib.fit.output_error import expected_residual

    given = residual_std(words, work.robot)
    # Fitted once, before the first cell that needs it.
    fitted = functools.cache(
        lambda: expected_residual(Problem(work.robot, work.space, work.episodes, threads=threads))
    )

    def std(method: str) -> FloatArray | None:
        return given if given is not None or method in UNTOLD else fitted()

    return std


def cells(
    recordings: Recordings,
    holdout: Sequence[Path],
    *,
    methods: Sequence[str],
    seeds: Sequence[int],
    range_ratio: float,
    std: Sequence[str],
    refine_all: bool,
    budget: Budget,
    window_s: float,
    threads: int | None,
    quiet: bool,
) -> Cells:
    """Read and check the recordings and return the cells; see :func:`run_cell`.

    Raises:
        UnknownNameError: There is no such method.
        ConfigurationError: No model was named, or a setting cannot be used.
        DatasetError: A recording cannot be used.
    """
    for method in methods:
        check_method(method)
    task = Path(recordings.model or "").stem
    # A file of parameters has ranges of its own.
    ratio = range_ratio if recordings.parameters is None else None
    work = prepare(recordings, holdout, ratio, std, threads=threads, quiet=quiet)
    split, expected = split_name(recordings, holdout), expected_std(work, std, threads)

    def make(method: str, seed: int, refine: bool) -> Callable[[], Row]:
        return lambda: run_cell(
            work,
            task,
            split,
            method,
            seed,
            range_ratio,
            refine=refine,
            std=expected(method),
            threads=threads,
            budget=budget,
            window_s=window_s,
        )

    runs = []
    for seed, method in itertools.product(seeds, methods):
        refine = method == "default" or refine_all
        runs.append(((task, split, method, refine, range_ratio, seed), make(method, seed, refine)))
    return Cells(names=KEY, runs=runs)


def run_cell(
    work: CalibrationInputs,
    task: str,
    split: str,
    method: str,
    seed: int,
    range_ratio: float,
    *,
    refine: bool,
    budget: Budget,
    std: FloatArray | None,
    window_s: float,
    threads: int | None,
) -> dict[str, Any]:
    """Calibrate with one method and judge on what it has not seen; an error is kept in the row.

    Args:
        work: What was prepared.
        task: Name of the robot in the row.
        split: What is held out.
        method: Name of the method.
        seed: Of everything random.
        range_ratio: Ratio of the search range, for the row.
        refine: Whether the refinement follows.
        budget: What the search may use.
        std: What a prediction may be off, (2 C,); None: the sensor noise, or what the method finds itself.
        window_s: Held-out predictions restart this often [s].
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
        "error": "",
    }
    try:
        result = calibrate_episodes(
            work.robot,
            work.space,
            work.episodes,
            work.holdout,
            method=method,
            budget=dataclasses.replace(budget, refine=refine),
            rng=np.random.default_rng(seed),
            threads=threads,
            heldout_window_s=window_s,
            known_std=std,
            # A model that nobody calibrated has no latency.
            latency_s=0.0 if method == "nominal" else None,
        )
    except DealHwError as err:
        row["error"] = f"{type(err).__name__}: {err}"
        return row
    unit = work.space.normalize(result.estimate)
    rmse = result.provenance.get("heldout_rmse", {})
    row |= {f"heldout_nrmse_{name}": value for name, value in result.heldout_nrmse.items()}
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
            name for name, u in zip(work.space.names, unit, strict=True) if u < 1e-6 or u > 1 - 1e-6
        ],
        "null_directions": list(result.null_directions),
        **{
            name: result.provenance.get(name)
            for name in ("cross_validation", "split_half", "confounded", "heldout_rmse")
        },
        "estimate": dict(zip(work.space.names, map(float, result.estimate), strict=True)),
    }
    return row
