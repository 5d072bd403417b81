"""The real bench: methods against each other on recordings of a real robot, judged on held-out motion.

There is no truth, so a row has held-out errors instead of parameter errors. All methods get the same
recordings, parameters, ranges and budget.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.calibration import Budget
from deal_hw.cli.calibrate_model import Recordings, prepare_model
from deal_hw.cli.calibrate_run import Narrowing, Work, calibrate_episodes, residual_std
from deal_hw.errors import ConfigurationError, DealHwError

KEY = ("task", "method", "polish", "xi", "seed")


def prepare(
    recordings: Recordings,
    holdout: Sequence[Path],
    xi: float | None,
    std: Sequence[str],
    *,
    threads: int | None,
    quiet: bool,
) -> Work:
    """Read and check model, recordings and parameters once for all cells.

    Raises:
        ConfigurationError: No model was named, or a setting cannot be used.
        DatasetError: A recording cannot be used.
    """
    if recordings.model is None:
        raise ConfigurationError(
            "bench real needs --model robot.xml --data rec.csv ... (docs/any-robot.md), and --holdout "
            "other.csv or a part of each recording (--holdout-part)"
        )
    narrowing = Narrowing(free=(), known={}, ranges=(), xi=xi)
    return prepare_model(
        recordings,
        holdout,
        narrowing,
        std=lambda robot: residual_std(std, robot),
        threads=threads,
        quiet=quiet,
    )


def run_cell(
    work: Work,
    task: str,
    method: str,
    seed: int,
    xi: float,
    *,
    polish: bool,
    budget: Callable[[bool], Budget],
    std: Sequence[str],
    window_s: float,
    threads: int | None,
) -> dict[str, Any]:
    """Calibrate with one method and judge on what it has not seen; an error is kept in the row.

    Args:
        work: What was prepared.
        task: Name of the robot in the row.
        method: Name of the method.
        seed: Of everything random.
        xi: Ratio of the search range, for the row.
        polish: Whether the polish follows.
        budget: Makes the budget.
        std: What a prediction may be off, as for ``deal-hw calibrate --residual-std``.
        window_s: Held-out predictions restart this often [s].
        threads: Simulation threads.
    """
    row: dict[str, Any] = {
        "bench": "real", "task": task, "profile": "real", "method": method, "polish": polish, "xi": xi,
        "seed": seed, "error": "",
    }  # fmt: skip
    try:
        result = calibrate_episodes(
            work.robot, work.space, work.episodes, work.holdout, method=method, budget=budget(polish),
            rng=np.random.default_rng(seed), threads=threads, known_std=residual_std(std, work.robot),
            heldout_window_s=window_s,
        )  # fmt: skip
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
        "alarms": list(result.alarms),
        "chi2": result.chi2,
        "at_bound": [
            name for name, u in zip(work.space.names, unit, strict=True) if u < 1e-6 or u > 1 - 1e-6
        ],
        "folds": result.provenance.get("folds"),
        "halves": result.provenance.get("halves"),
        "estimate": dict(zip(work.space.names, map(float, result.estimate), strict=True)),
    }
    return row
