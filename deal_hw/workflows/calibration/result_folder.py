"""The folder of a calibration: its state and its best fit so far while it runs, then its results.

A fit is on the disk as soon as there is one, so that neither Ctrl-C nor a crash nor a kill loses it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deal_hw.calibration import BEFORE_SEARCH, CalibrationResult, Progress, ProgressCallback, percent
from deal_hw.errors import CalibrationError, ConfigurationError, DealHwError, ModelNotWrittenError
from deal_hw.findings import Finding, SafeChecks
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray
from deal_hw.workflows.say import Say, silent, to_stderr

if TYPE_CHECKING:
    from deal_hw.calib.report.gather import ReportInputs
    from deal_hw.sim.engine.model import RobotModel

CHECKPOINT = "checkpoint.npz"
SO_FAR = "so_far"
HELD_OUT = "the held-out error"
"""Name of a check."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultFolder:
    """The folder of a calibration.

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
        """Folder of the best fit of an unfinished calibration; removed when the results are written."""
        return self.path / SO_FAR

    @property
    def next_step(self) -> str:
        """How a calibration goes on that ends now: the one sentence for the terminal and for the file."""
        if self.checkpoint.exists():
            return (
                f"Its state is in {self.checkpoint}: the same command with --resume continues, to the same "
                "result."
            )
        return "No search had begun, so there is no state to --resume: run the same command again."

    def clear_so_far(self) -> None:
        """Remove the best fit of an earlier calibration."""
        shutil.rmtree(self.so_far, ignore_errors=True)

    def keep(self, robot: RobotModel, result: CalibrationResult) -> Path:
        """Write the numbers of the best fit so far, and return their folder.

        Its other files are written when the calibration is stopped.
        """
        from deal_hw.calib.report.page import write_numbers

        numbers = write_numbers(self.so_far, robot, result)
        for other in self.so_far.iterdir():
            # Of an earlier fit, which a resumed calibration has found there.
            if other.name not in numbers:
                other.unlink()
        return self.so_far

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
            result: The result. The state to resume from stays if its checks were not made.
            report: Contents of report.html; None: it is not written.
            stopped: It is the best fit of a stopped calibration, for the folder of such.

        Raises:
            ModelNotWrittenError: The calibrated model cannot be written; all other files are complete.
            KeyboardInterrupt: Ctrl-C; the files are complete.
        """
        from deal_hw.calib.report.page import write_result
        from deal_hw.data.files import interrupts_deferred

        problem: ModelNotWrittenError | None = None
        # A Ctrl-C here must neither lose an hour's work nor leave half of the files.
        with interrupts_deferred():
            try:
                files = write_result(self.so_far if stopped else self.path, robot, result, report)
            except ModelNotWrittenError as err:
                problem, files = err, err.files
            if not result.unchecked:
                self.checkpoint.unlink(missing_ok=True)
            if not stopped:
                self.clear_so_far()
        if problem is not None:
            raise problem
        return files

    @contextlib.contextmanager
    def resumable(self) -> Iterator[None]:
        """On Ctrl-C say how the calibration goes on, and raise the interrupt again."""
        try:
            yield
        except KeyboardInterrupt:
            to_stderr(f"\ncalibration stopped. {self.next_step}")
            raise


class UnfinishedCalibrationError(CalibrationError):
    """Something raised after the first fit of a calibration.

    Args:
        message: What.
        result: The best fit so far, as one whose checks were not made.
    """

    def __init__(self, message: str, result: CalibrationResult) -> None:
        super().__init__(message)
        self.result = result


def unfinished(result: CalibrationResult, how: str, next_step: str) -> CalibrationResult:
    """Return a fit as one whose checks were not made.

    Args:
        result: The fit.
        how: How its calibration ended, as the end of a sentence.
        next_step: How it goes on, as a sentence.
    """
    intervals = "No interval was computed: the given ones are the search ranges."
    if result.covariance is not None:
        intervals = "Its intervals are those of the fit."
    return result.with_unchecked(
        Finding.alarm(
            f"The calibration {how}.",
            f"Checks of this result were not made, or not to their end. {intervals}",
            next_step,
        )
    )


class BestSoFar:
    """Receives the progress of a calibration: keeps the best fit on the disk, and reports clear gains.

    The fit that the result will have takes the place of all others, whatever its error: intervals and checks
    are of that one.

    Attributes:
        raised: What the receiver of the progress raised, to stop the calibration.

    Args:
        space: The parameters.
        judge: Returns the held-out errors of a fit, (K,) and latency [s] with its parameters, as
            "calibrated", beside "nominal" and "null"; None without held-out data.
        say: Called with a sentence on each fit whose error is 5 % lower than the one reported before, and
            with each message before the search.
        progress: Called with the progress, too; None: nobody else is.
        keep: Writes a result, and returns where.
        next_step: Returns how the calibration goes on that ends now, as a sentence.
    """

    def __init__(
        self,
        space: ParameterSpace,
        judge: Callable[[FloatArray, float, ParameterSpace], Mapping[str, float]] | None,
        say: Say = silent,
        progress: ProgressCallback | None = None,
        *,
        keep: Callable[[CalibrationResult], Path] | None = None,
        next_step: Callable[[], str] = lambda: "Calibrate again.",
    ) -> None:
        self._space, self._judge, self._say, self._progress = space, judge, say, progress
        self._keep, self._next_step, self._kept_step = keep, next_step, ""
        self._kept: Path | None = None
        self._began = time.monotonic()
        self._error = self._said = math.inf
        self._best: CalibrationResult | None = None
        self.raised: Exception | None = None

    def __call__(self, progress: Progress) -> None:
        """Note a step of the calibration."""
        if progress.fitted is not None:
            self.take(progress.fitted)
        if progress.estimate is not None:
            self._compare(progress, progress.estimate)
        if progress.stage == BEFORE_SEARCH:
            self._say(f"{BEFORE_SEARCH}: {progress.message}")
        if self._kept_step != self._next_step():
            # A search has begun since the fit was written, so what the file says of --resume is another now.
            self._write()
        if self._progress is not None:
            try:
                self._progress(progress)
            except Exception as err:
                self.raised = err
                raise

    @property
    def result(self) -> CalibrationResult | None:
        """The best fit so far, as one whose checks were not made; None before the first fit."""
        return None if self._best is None else self.ended("was not finished")

    def ended(self, how: str, do: str = "") -> CalibrationResult:
        """Return the best fit so far of a calibration that ended before its time.

        Args:
            how: How it ended, as the end of a sentence.
            do: What to do before it goes on, as a sentence.

        Raises:
            ValueError: There is no fit yet.
        """
        if self._best is None:
            raise ValueError("no fit was found yet")
        after_s = time.monotonic() - self._began
        how = f"{how}: this is the result of its {self._best.method}, after {after_s:.0f} s"
        found = unfinished(self._best, how, f"{do} {self._next_step()}".strip())
        return dataclasses.replace(found, method=f"interrupted after {self._best.method}", seconds=after_s)

    def take(self, fitted: CalibrationResult) -> None:
        """Take a fit with intervals in place of the best one."""
        errors = fitted.heldout_nrmse
        if not errors and self._best is not None and _same_values(self._best, fitted):
            errors = self._best.heldout_nrmse
        errors = errors or self._errors(fitted.estimate, fitted.latency_s, fitted.space)
        self._error = errors.get("calibrated", fitted.chi2)
        self._best = dataclasses.replace(fitted, heldout_nrmse=errors)
        self._write()

    def _compare(self, progress: Progress, estimate: FloatArray) -> None:
        """Compare a fit with the best one so far."""
        latency_s = progress.latency_s or 0.0
        space = progress.space or self._space
        errors = self._errors(estimate, latency_s, space)
        error = errors.get("calibrated", progress.values.get("chi2", math.inf))
        if self._best is not None and not error < self._error:
            return
        self._error = error
        space = space.holding(estimate)
        self._best = CalibrationResult(
            method=progress.stage,
            space=space,
            estimate=estimate,
            interval=np.stack([space.low, space.high], axis=1),
            latency_s=latency_s,
            latency_interval_s=(latency_s, latency_s),
            chi2=progress.values.get("chi2", math.nan),
            heldout_nrmse=errors,
        )
        self._write()
        if self._error > 0.95 * self._said:
            return
        self._said = self._error
        self._say(f"{time.monotonic() - self._began:.0f} s, {progress.stage}: {self.sentence}")

    def _errors(self, estimate: FloatArray, latency_s: float, space: ParameterSpace) -> Mapping[str, float]:
        """Return the held-out errors of a fit; none where they cannot be computed."""
        if self._judge is None:
            return {}
        return SafeChecks().run(HELD_OUT, {}, self._judge, estimate, latency_s, space)

    def _write(self) -> None:
        """Write the best fit; where that fails, the calibration goes on."""
        self._kept_step = self._next_step()
        found = self.result
        if found is None or self._keep is None:
            return
        try:
            kept = self._keep(found)
        except (OSError, DealHwError) as err:
            self._say(f"the best fit so far cannot be kept: {err}")
            return
        if self._kept is None:
            self._say(f"the best fit so far is in {kept}, not checked, until the calibration ends")
        self._kept = kept

    @property
    def sentence(self) -> str:
        """Error of the best fit, as a sentence."""
        if self._best is None:
            return "no fit yet"
        errors = self._best.heldout_nrmse
        if errors:
            return (
                f"held-out error {percent(errors['calibrated'])} of the signal's range "
                f"(your own model: {percent(errors['nominal'])})"
            )
        return f"residuals {math.sqrt(max(self._best.chi2, 0.0)):.2g} times the sensor's noise"


def _same_values(one: CalibrationResult, other: CalibrationResult) -> bool:
    """Return whether two fits predict the same."""
    same = one.space.names == other.space.names and one.latency_s == other.latency_s
    return same and bool(np.array_equal(one.estimate, other.estimate))
