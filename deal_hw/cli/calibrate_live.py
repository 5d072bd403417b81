"""A calibration that can be stopped and looked at: its checkpoint file, and its live view."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calibration import Budget, CalibrationMethod, ProgressCallback
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray, Trajectory

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem
    from deal_hw.calib.search.checkpoint import Checkpoint
    from deal_hw.sim.recordings.overlay import Overlay

CHECKPOINT = "checkpoint.npz"
"""Beside the results while the calibration runs; gone when it is over."""


def open_checkpoint(
    path: Path,
    resume: bool,
    problem: Problem,
    method: CalibrationMethod[Any],
    budget: Budget,
    rng: np.random.Generator,
) -> Checkpoint:
    """Return the checkpoint of a run that is about to begin or to go on.

    Args:
        path: The file.
        resume: Go on with what the file holds; otherwise it is replaced after the first generation.
        problem: Data and simulator.
        method: The method.
        budget: How much it may use.
        rng: The run's generator, before it has drawn anything.
    """
    from deal_hw.calib.search.checkpoint import Checkpoint
    from deal_hw.calib.search.identity import run_identity

    return Checkpoint(path, run_identity(problem, method, budget, rng), fresh=not resume)


def check_resume(path: Path, resume: bool) -> None:
    """Check that there is something to go on with.

    Raises:
        ConfigurationError: There is not.
    """
    if resume and not path.exists():
        raise ConfigurationError(
            f"there is nothing to resume: {path} does not exist; leave --resume out to begin a calibration"
        )


@contextlib.contextmanager
def saying_how_to_resume(path: Path) -> Iterator[None]:
    """On Ctrl-C say where the state is and how to go on with it, and let the interrupt through."""
    try:
        yield
    except KeyboardInterrupt:
        if path.exists():
            print(
                f"\ncalibration stopped; its state is in {path}: "
                "the same command with --resume goes on, to the same numbers",
                file=sys.stderr,
            )
        else:
            print("\ncalibration stopped before its first generation; nothing is kept", file=sys.stderr)
        raise


@contextlib.contextmanager
def watching(
    watch: bool,
    save: Path | None,
    space: ParameterSpace,
    description: RobotDescription,
    trajectory: Trajectory,
    latency_s: float | None,
) -> Iterator[ProgressCallback | None]:
    """Show a search while it runs, until the block ends.

    Args:
        watch: In a window, or for a browser where there is no desktop.
        save: File of the view, .rrd.
        space: What is searched.
        description: The robot.
        trajectory: The recording to show predictions of.
        latency_s: The latency, where it is known [s].

    Yields:
        What to call with the progress; None where nothing is to be shown.
    """
    if not watch and save is None:
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
                print(f"watch the search at {page}  (this machine only)", file=sys.stderr)
        yield stack.enter_context(population_view(space, address=address, save=save, predict=predict)).show
