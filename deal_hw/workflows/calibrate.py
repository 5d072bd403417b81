"""``deal_hw.calibrate``: find the simulator parameters that explain recordings, from Python."""

from __future__ import annotations

import contextlib
import dataclasses
import html
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from deal_hw.calibration import CalibrationResult, ProgressCallback
from deal_hw.parameters import ParameterDistribution
from deal_hw.workflows.calibration.intake import CalibrationInput, calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_input, judged
from deal_hw.workflows.calibration.settings import FilesSettings, python_kinds
from deal_hw.workflows.options import FROM_PYTHON, from_settings
from deal_hw.workflows.say import Say, html_table, silent, text_table

_HEAD = ("parameter", "unit", "nominal", "estimate", "90 % interval", "verdict")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What a calibration found.

    Attributes:
        result: Estimates, intervals, verdicts, alarms.
        inputs: The robot, recordings and parameters.
        threads: Simulation threads of the report.
    """

    result: CalibrationResult
    inputs: CalibrationInput
    threads: int | None = None

    @property
    def distribution(self) -> ParameterDistribution:
        """The calibrated distribution of the parameters, for training a policy."""
        from deal_hw.calib.report.page import model_distribution

        return model_distribution(self.inputs.robot, self.result)

    @property
    def colour(self) -> str:
        """Whether the result can be used: green, amber or red."""
        from deal_hw.calib.report.verdict import trust

        return trust(self.result).colour

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per parameter and the latency: name, unit, nominal, estimate, low, high, verdict."""
        result = self.result
        verdicts = result.verdicts or ("",) * len(result.space)
        rows: list[dict[str, Any]] = [
            {
                "parameter": p.name,
                "unit": p.unit,
                "nominal": p.nominal,
                "estimate": float(estimate),
                "low": float(low),
                "high": float(high),
                "verdict": verdict,
            }
            for p, estimate, (low, high), verdict in zip(
                result.space, result.estimate, result.interval, verdicts, strict=True
            )
        ]
        low, high = result.latency_interval_s
        latency = {"parameter": "latency", "unit": "s", "nominal": 0.0, "estimate": result.latency_s}
        return [*rows, {**latency, "low": low, "high": high, "verdict": ""}]

    def table(self) -> str:
        """Return the parameters with their 90 % intervals and verdicts, as text."""
        return "\n".join([text_table(_HEAD, map(_cells, self.rows())), "", *self._words()])

    def report(self, path: Path | str) -> Path:
        """Write all results to one HTML page and return its path; takes some seconds.

        Args:
            path: The file; a folder gets ``report.html``.
        """
        from deal_hw.calib.report.page import REPORT, write_report

        path = Path(path)
        window_s = self.result.provenance["heldout_window_s"]
        _, shown = judged(
            self.inputs,
            self.result,
            {"heldout_window_s": window_s},
            page=True,
            advise=False,
            threads=self.threads,
        )
        assert shown is not None
        write_report(path, shown)
        return path / REPORT if path.is_dir() else path

    def save_model(self, path: Path | str) -> Path:
        """Write the calibrated MJCF and return its path.

        Raises:
            ConfigurationError: It is the model's own file, or a value cannot be written.
        """
        from deal_hw.calib.report.page import write_model
        from deal_hw.sim.mjcf.calibrated import require_other

        path, robot = Path(path), self.inputs.robot
        require_other(path, robot.description.mjcf)
        write_model(robot, self.result, path)
        return path

    def save(self, folder: Path | str) -> dict[str, Path]:
        """Write the files of ``deal-hw calibrate`` except the report; return them by name."""
        from deal_hw.calib.report.page import write_result
        from deal_hw.workflows.calibration.run import plain_model

        provenance = {**self.result.provenance, **plain_model(self.inputs, self.result)}
        result = dataclasses.replace(self.result, provenance=provenance)
        return write_result(Path(folder), self.inputs.robot, result)

    def _words(self) -> list[str]:
        from deal_hw.calib.report.verdict import trust

        found = trust(self.result)
        unknown = [f"the data do not determine: {words}" for words in self.result.null_directions]
        alarms = [f"alarm: {alarm}" for alarm in self.result.alarms]
        return [f"{found.colour}: {found.sentence}", *unknown, *self.result.prior_directions, *alarms]

    def __repr__(self) -> str:
        return f"<Calibration of {len(self.result.space)} parameters, {self.colour}; table() shows them>"

    def _repr_html_(self) -> str:
        words = "".join(f"<p>{html.escape(line)}</p>" for line in self._words())
        return html_table(_HEAD, map(_cells, self.rows())) + words


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    value = "no value" if row["verdict"] == "not identifiable" else f"{row['estimate']:.4g}"
    return (
        row["parameter"],
        row["unit"],
        f"{row['nominal']:.4g}",
        value,
        f"{row['low']:.4g} to {row['high']:.4g}",
        row["verdict"],
    )


@dataclass(frozen=True, kw_only=True)
class CalibrateCalls:
    """Functions that a calibration from Python calls."""

    progress: Annotated[ProgressCallback | None, FROM_PYTHON] = None
    """Called with each :class:`~deal_hw.calibration.Progress`."""

    say: Annotated[Say, FROM_PYTHON] = silent
    """Called with sentences on guesses and findings; ``print`` shows them."""


@from_settings(python_kinds().with_options(CalibrateCalls))
def calibrate(settings: Any) -> Calibration:
    """Find the simulator parameters that explain recordings, as ``deal-hw calibrate``.

    The arguments are settings: of any robot its model and recordings, ``calibrate("robot.xml", ["rec.csv"])``
    (:class:`~deal_hw.workflows.calibration.settings.FilesSettings`), or a dataset,
    ``calibrate(dataset="runs/first/dataset")``
    (:class:`~deal_hw.workflows.calibration.settings.DriverDatasetSettings`, with its own robot.yaml
    :class:`~deal_hw.workflows.calibration.settings.OwnDatasetSettings`); and those of
    :class:`CalibrateCalls`.

    Returns:
        Estimates with intervals and verdicts; see :class:`Calibration`.

    Raises:
        DealHwError: A setting or a recording is unusable; raised before any long work.
    """
    with contextlib.ExitStack() as kept:
        if isinstance(settings, FilesSettings):
            from deal_hw.sim.mjcf.model_file import mjcf_file

            scratch = Path(tempfile.mkdtemp(prefix="deal-hw-"))
            kept.callback(shutil.rmtree, scratch, ignore_errors=True)
            settings = dataclasses.replace(settings, model=mjcf_file(settings.model, scratch))
        say = settings.say
        inputs = calibration_input(settings, say=say)
        chosen = usual_method(settings, inputs, say)
        result = calibrate_input(settings, inputs, chosen, progress=settings.progress, say=say)
        threads = settings.threads
        result, _ = judged(inputs, result, settings.provenance, page=False, advise=False, threads=threads)
        found = Calibration(result=result, inputs=inputs, threads=threads)
        # Writing the calibrated model reads the model's file again.
        weakref.finalize(found, kept.pop_all().close)
    return found
