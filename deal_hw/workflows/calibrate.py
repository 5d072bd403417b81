"""``deal_hw.calibrate``: find the simulator parameters that explain recordings, from Python."""

from __future__ import annotations

import contextlib
import html
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from deal_hw.calibration import LATENCY_RANGE_S, CalibrationResult, ProgressCallback
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterDistribution
from deal_hw.workflows.calibration.intake import CalibrationInput, calibration_input, usual_method
from deal_hw.workflows.calibration.recordings import Recorded
from deal_hw.workflows.calibration.run import calibrate_input, judged
from deal_hw.workflows.calibration.settings import (
    HELDOUT_WINDOW_S,
    CalibrateSettings,
    Recordings,
    check_source,
)
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
        return self.result.distribution()

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

        return write_result(Path(folder), self.inputs.robot, self.result)

    def _words(self) -> list[str]:
        from deal_hw.calib.report.verdict import trust

        found = trust(self.result)
        unknown = [f"the data do not determine: {words}" for words in self.result.null_directions]
        alarms = [f"alarm: {alarm}" for alarm in self.result.alarms]
        return [f"{found.colour}: {found.sentence}", *unknown, *alarms]

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


def calibrate(
    model: Any = None,
    data: Recorded | Sequence[Recorded] = (),
    *,
    dataset: Path | str | None = None,
    holdout: Recorded | int | Sequence[Recorded | int] = (),
    episodes: Sequence[int] = (),
    columns: Path | str | None = None,
    parameters: Path | str | None = None,
    space: str = "",
    free: Sequence[str] = (),
    known: Mapping[str, float] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    range_ratio: float | None = None,
    latency_s: float | None = None,
    latency_range_s: tuple[float, float] = LATENCY_RANGE_S,
    residual_std: float | Mapping[str, float] | None = None,
    feet: Sequence[str] = (),
    holdout_part: float | None = None,
    leave_out: Sequence[tuple[str, float, float]] = (),
    fit_seconds: float = Recordings().fit_seconds,
    window_s: float = Recordings().window,
    physics_step_s: float | None = None,
    force: bool = False,
    sample_hz: float | None = None,
    spike_ratio: float = CalibrateSettings.spike_ratio,
    heldout_window_s: float = HELDOUT_WINDOW_S,
    method: str = "",
    search: Literal["deal", "eki", "deal-paper"] | None = None,
    checks: Literal["usual", "all"] = CalibrateSettings.checks,
    refine: bool = True,
    population: int | None = None,
    generations: int | None = None,
    policy: Path | str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    say: Say = silent,
) -> Calibration:
    """Find the simulator parameters that explain recordings.

    Args:
        model: The robot's MJCF (path), ``mujoco.MjSpec`` or last compiled ``mujoco.MjModel``.
        data: Recordings to fit: files (CSV, NPZ, MCAP, LeRobot folders), mappings of names to arrays, or data
            frames. Positions [rad or m] (T, J), commands (T, A), time [s] (T,).
        dataset: A dataset of ``deal-hw collect`` or ``data import``, instead of model and data.
        holdout: Held-out data, which only test the result: recordings, or episodes of the dataset.
        episodes: Episodes of the dataset to fit; all but the held-out ones by default.
        columns: Column map (YAML) of the recordings.
        parameters: Parameters to search (YAML); friction, damping, armature and gains by default.
        space: Parameter set of the dataset's robot.
        free: Search exactly these parameters.
        known: Values measured by other means, by name (SI).
        ranges: Search ranges, low and high by name (SI).
        range_ratio: Search from nominal / range_ratio to nominal * range_ratio; by default as the parameter
            set defines, mostly 5.
        latency_s: Total latency if it is known [s].
        latency_range_s: Range of the latency search otherwise [s].
        residual_std: Expected standard deviation of the prediction error [rad, m], for all joints or by
            joint; the sensor noise by default.
        feet: Sphere geoms of a floating robot's feet.
        holdout_part: Without ``holdout`` this last share of each recording is held out; 0.25 by default.
        leave_out: Parts of recordings that the model cannot explain, such as a contact: file name, from, to
            [s from its start].
        fit_seconds: Most seconds to fit, spread evenly over the recordings [s].
        window_s: Length of the longest prediction windows of the search [s].
        physics_step_s: Requested physics step [s]; the MJCF's timestep by default.
        force: Use recordings although a check of them failed.
        sample_hz: Rate of the fitted states of a dataset [Hz]; by default four per control period.
        spike_ratio: A sample is left out if it jumps away and back by more than this multiple of the joint's
            fastest motion.
        heldout_window_s: Held-out predictions restart from the measured state after this time [s].
        method: The pipeline (default, output-error, local, gait, nominal) or a baseline; by default chosen
            from the recordings.
        search: The search inside the pipeline: deal, eki or deal-paper.
        checks: "usual" ends the checks of recordings that the model does not explain where they take more
            physics steps than the fits; "all" runs them to their end.
        refine: Follow the search by multiple shooting on prediction error.
        population: Members of the search; the method's usual number by default.
        generations: Most generations of the search.
        policy: The policy that moved the robot (.onnx). With a model it gives the commands of recordings
            without any, and checks the clock of recorded ones; with a dataset it is for methods that run it
            (``deal-paper``).
        seed: Seed of all random numbers.
        threads: Simulation threads; all processors by default.
        progress: Called with each :class:`~deal_hw.calibration.Progress`.
        say: Called with sentences on guesses and findings; ``print`` shows them.

    Returns:
        Estimates with intervals and verdicts; see :class:`Calibration`.

    Raises:
        DealHwError: A setting or a recording is unusable; raised before any long work.
    """
    fit, judges = _listed(data), _listed(holdout)
    try:
        fixed = tuple((name, float(value)) for name, value in (known or {}).items())
        searched = tuple((name, float(low), float(high)) for name, (low, high) in (ranges or {}).items())
        left_out = tuple((name, float(begin), float(end)) for name, begin, end in leave_out)
    except (AttributeError, TypeError, ValueError) as err:
        raise ConfigurationError(
            'write known={"cart.mass": 0.41}, ranges={"cart.mass": (0.1, 1.0)} and '
            f'leave_out=[("rec.csv", 1.5, 2.0)] like this; one of them is different ({err})'
        ) from err
    check_source(dataset=dataset, model=model is not None, data=bool(fit))
    with contextlib.ExitStack() as kept:
        path = None
        if model is not None:
            from deal_hw.sim.mjcf.model_file import mjcf_file

            scratch = Path(tempfile.mkdtemp(prefix="deal-hw-"))
            kept.callback(shutil.rmtree, scratch, ignore_errors=True)
            path = mjcf_file(model, scratch)
        settings = CalibrateSettings(
            dataset=dataset,
            recordings=Recordings(
                model=path,
                columns=None if columns is None else Path(columns),
                parameters=None if parameters is None else Path(parameters),
                feet=(feet,) if isinstance(feet, str) else tuple(feet),
                holdout_part=holdout_part,
                leave_out=left_out,
                fit_seconds=fit_seconds,
                window=window_s,
                physics_step=physics_step_s,
                force=force,
            ),
            sample_hz=sample_hz,
            spike_ratio=spike_ratio,
            episodes=tuple(episodes),
            heldout_window=heldout_window_s,
            method=method,
            search=search,
            checks=checks,
            policy=policy,
            space=space,
            free=(free,) if isinstance(free, str) else tuple(free),
            known=fixed,
            range=searched,
            range_ratio=range_ratio,
            latency=latency_s,
            latency_range=latency_range_s,
            residual_std=residual_std,
            population=population,
            generations=CalibrateSettings.generations if generations is None else generations,
            refine=refine,
            seed=seed,
            threads=threads,
        )
        inputs = calibration_input(settings, data=fit, holdout=judges, say=say)
        chosen = usual_method(settings, inputs, say)
        result = calibrate_input(settings, inputs, chosen, progress=progress, say=say)
        result, _ = judged(inputs, result, settings.provenance, page=False, advise=False, threads=threads)
        found = Calibration(result=result, inputs=inputs, threads=threads)
        # Writing the calibrated model reads the model's file again.
        weakref.finalize(found, kept.pop_all().close)
    return found


def _listed(given: Any) -> list[Any]:
    """Return one recording, or several, as a list."""
    alone = isinstance(given, str | Path | int | Mapping) or hasattr(given, "columns")
    return [given] if alone else list(given)
