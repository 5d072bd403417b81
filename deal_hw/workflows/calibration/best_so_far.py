"""Stop, resume and watch a calibration: its checkpoint file, its best fit so far, and its live view."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.calibration import BEFORE_SEARCH, CalibrationResult, Progress, ProgressCallback, percent
from deal_hw.description import RobotDescription
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.findings import Finding
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray, Trajectory
from deal_hw.workflows.say import Say, silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.sim.engine.model import RobotModel
    from deal_hw.sim.recordings.overlay import Overlay

CHECKPOINT = "checkpoint.npz"
"""Checkpoint beside the results; removed at the end of the calibration."""

SO_FAR = "so_far"
"""Folder beside the results for the best fit of a stopped calibration."""


def check_resume(path: Path, resume: bool) -> None:
    """Check that there is a checkpoint to resume.

    Raises:
        ConfigurationError: There is none.
    """
    if resume and not path.exists():
        raise ConfigurationError(
            f"nothing to resume: {path} does not exist; leave --resume out to begin a calibration"
        )


class BestSoFar:
    """Receives the progress of a calibration: keeps the best fit for an interrupt, and reports clear gains.

    Args:
        space: The parameters.
        judge: Returns the held-out errors of a fit, (K,) and latency [s], as "calibrated", beside "nominal"
        and "null"; None without held-out data.
        say: Called with a sentence on each fit whose error is 5 % lower than the one reported before, and
            with each message before the search.
        progress: Called with the progress, too; None: nobody else is.
    """

    def __init__(
        self,
        space: ParameterSpace,
        judge: Callable[[FloatArray, float], Mapping[str, float]] | None,
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
        errors = self._judge(estimate, latency_s) if self._judge is not None else {}
        error = errors.get("calibrated", progress.values.get("chi2", math.inf))
        if self.result is not None and not error < self._error:
            return
        self._error = error
        low_high = np.stack([self._space.low, self._space.high], axis=1)
        self.result = CalibrationResult(
            method=f"interrupted after {progress.stage}",
            space=self._space,
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


@contextlib.contextmanager
def keeping_best(best: BestSoFar, folder: Path, robot: RobotModel) -> Iterator[None]:
    """On Ctrl-C write the best fit so far, if any, and raise the interrupt again."""
    try:
        yield
    except KeyboardInterrupt:
        if best.result is not None:
            from deal_hw.calib.report.page import write_result
            from deal_hw.data.files import interrupts_deferred

            with interrupts_deferred():
                write_result(folder, robot, best.result)
            to_stderr(f"\nbest so far: {best.sentence}; written to {folder}, without intervals")
        raise


@contextlib.contextmanager
def saying_how_to_resume(path: Path) -> Iterator[None]:
    """On Ctrl-C say where the state is and how to continue, and raise the interrupt again."""
    try:
        yield
    except KeyboardInterrupt:
        if path.exists():
            to_stderr(
                f"\ncalibration stopped; its state is in {path}. The same command with --resume continues, "
                "to the same result"
            )
        else:
            to_stderr("\ncalibration stopped before the search; there is no state to --resume, begin again")
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
    """Show a running search until the block ends.

    Args:
        watch: In a window, or in a browser if there is no desktop.
        save: File of the view, .rrd.
        space: The parameters.
        description: The robot.
        trajectory: The recording whose predictions are shown.
        latency_s: The latency, if it is known [s].

    Yields:
        A function to call with the progress; None if nothing is shown.
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
                to_stderr(f"watch the search at {page}  (this machine only)")
        yield stack.enter_context(population_view(space, address=address, save=save, predict=predict)).show
