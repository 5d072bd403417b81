"""Output of a calibration: the report's page, and the result folder with numbers, trace and model."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from deal_hw.calib.hypotheses.judge import needed
from deal_hw.calib.hypotheses.recording_zeros import next_zeros
from deal_hw.calib.report import charts
from deal_hw.calib.report.gather import ReportInputs
from deal_hw.calib.report.verdict import grouped, make_story, trust
from deal_hw.calibration import RESULT_FILE, CalibrationResult, percent, std_words
from deal_hw.data.files import published_together, write_json
from deal_hw.errors import ConfigurationError, DatasetError, ModelNotWrittenError
from deal_hw.parameters import Parameter, ParameterDistribution
from deal_hw.sim.engine.model import RobotModel, at_step
from deal_hw.sim.mjcf.calibrated import require_other, write_calibrated_mjcf
from deal_hw.sim.mjcf.exports import write_exports
from deal_hw.sim.mjcf.plain import write_plain_mjcf
from deal_hw.sim.parameters.effort import EFFORT_KINDS
from deal_hw.sim.plain_model import FACTS, PLAIN_MODEL, difference_words

DISTRIBUTION = "distribution.json"
MODEL = "calibrated.xml"
TRACE = "trace.npz"
REPORT = "report.html"
TEMPLATE = "report.html.j2"

_HIDDEN = (
    "heldout_rmse",
    "cross_validation",
    "latency_scan",
    "search_estimate",
    "versions",
    "settings",
    "budget",
    "split_half",
    "candidates",
)
"""Provenance that the page shows elsewhere."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table of parameters; positions are percent of the search range.

    ``biased`` is the named cause of the residual that the value compensates for, or "".
    """

    parameter: Parameter
    estimate: float
    low: float
    high: float
    verdict: str
    has_value: bool
    outside: bool
    at_bound: str
    biased: str
    bar_left: float
    bar_width: float
    nominal_at: float
    estimate_at: float
    prior: str


def write_report(path: Path, inputs: ReportInputs) -> None:
    """Write the report to a file, or as ``report.html`` into a folder, whole or not at all.

    Raises:
        OSError: The file cannot be written.
    """
    path = path / REPORT if path.is_dir() else path
    text = render(inputs)
    with published_together(path.parent) as waiting:
        (waiting / path.name).write_text(text, encoding="utf-8", errors="backslashreplace")


def render(inputs: ReportInputs) -> str:
    """Return the page; everything from the user is escaped."""
    from jinja2 import Environment, StrictUndefined

    # StrictUndefined: a template name that this module lacks is an error, not a gap.
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["short"] = short
    environment.filters["short3"] = lambda value: short(value, 3)
    result = inputs.result
    rows = parameter_rows(result)
    provenance = dict(result.provenance)
    panels = sum(min(len(shown.names), charts.MOST_PANELS) for shown in inputs.overlays)
    heldout = _mapping(provenance.get("heldout_rmse"))
    names, joints = heldout_rows(heldout)
    matrix = charts.correlation_matrix(result)
    script = _asset("report.js")
    return environment.from_string(_asset(TEMPLATE)).render(
        inputs=inputs,
        result=result,
        # Our own files, not HTML: quotes in them stay quotes.
        style=Markup(_asset("report.css")),
        script=Markup(script),
        script_digest=script_digest(script),
        story=make_story(result),
        drawing=None if inputs.drawing is None else charts.robot(inputs.drawing),
        rows=rows,
        trust=trust(result),
        alarm_groups=grouped(result.alarms),
        counts=[
            (word, result.verdicts.count(word))
            for word in ("identifiable", "weak", "not identifiable")
            if word in result.verdicts
        ],
        weak=[n for n, v in zip(result.space.names, result.verdicts, strict=False) if v == "weak"],
        undetermined=[
            n
            for n, v in zip(result.space.names, result.verdicts, strict=False)
            if v == "not identifiable" and not any(n in words for words in result.null_directions)
        ],
        overlays=[(shown, charts.overlay(shown, panels)) for shown in inputs.overlays],
        windows=list(dict.fromkeys(short(shown.window_s) for shown in inputs.overlays)),
        panels_each=charts.MOST_PANELS,
        heldout_window_s=float(heldout.get("window_s") or provenance.get("heldout_window_s") or 0.0),
        heldout_names=names,
        heldout_joints=joints,
        split=_mapping(_mapping(provenance.get("split_half")).get("parameters")),
        residuals=[(shown, *charts.residuals(shown)) for shown in inputs.residuals],
        spread=charts.spread(inputs.spread) if inputs.spread else None,
        advice=advice_rows(result),
        scan=charts.latency_scan(_mapping(provenance.get("latency_scan")), inputs.tick_s),
        correlations=None if matrix is None else charts.correlations(matrix),
        strongest=[] if matrix is None else charts.strongest(matrix, result.space.names),
        strong=charts.STRONG,
        trace=charts.trace(result.trace),
        candidates=(candidates := candidate_rows(provenance.get("candidates") or ())),
        needed=needed(len(candidates)) if candidates else 0.0,
        compared=compared_fits(_mapping(provenance.get("cross_validation"))),
        population=[]
        if result.population is None
        else [
            (row, charts.ticks_in_range(unit))
            for row, unit in zip(rows, result.space.normalize(result.population).T, strict=True)
        ],
        facts=[(key, _plain(value)) for key, value in provenance.items() if key not in _HIDDEN],
        versions=_mapping(provenance.get("versions")),
        settings=[
            (f"{group}: {key}", _plain(value))
            for group in ("settings", "budget")
            for key, value in _mapping(provenance.get(group)).items()
        ],
    )


def _asset(name: str) -> str:
    return resources.files("deal_hw.calib.report").joinpath(name).read_text(encoding="utf-8")


def script_digest(script: str) -> str:
    """Return the digest of the page's only script, for its policy, which forbids all others."""
    digest = hashlib.sha256(f"\n{script}".encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


def parameter_rows(result: CalibrationResult) -> list[Row]:
    """Return the table of the searched parameters."""
    space = result.space
    at = [
        100 * np.clip(space.normalize(values), 0, 1)
        for values in (result.interval[:, 0], result.interval[:, 1], space.nominal, result.estimate)
    ]
    rows = []
    for k, p in enumerate(space):
        # Rounded to the share of the range that the alarm uses.
        bound = {0.0: "lower", 100.0: "upper"}.get(round(float(at[3][k]), 4), "")
        prior = ""
        if p.prior_mean is not None and p.prior_std is not None:
            spread = f"{100 * p.prior_std:.3g} %" if p.scale == "log" else f"{p.prior_std:.3g} {p.unit}"
            prior = f"expected {p.prior_mean:.4g} {p.unit} within {spread}"
        low, high = map(float, result.interval[k])
        verdict = result.verdicts[k] if result.verdicts else ""
        has_value = verdict != "not identifiable"
        rows.append(
            Row(
                parameter=p,
                estimate=float(result.estimate[k]),
                low=low,
                high=high,
                verdict=verdict,
                has_value=has_value,
                outside=has_value and not low <= result.estimate[k] <= high,
                at_bound=bound,
                biased=result.biased.get(p.name, ""),
                bar_left=float(at[0][k]),
                bar_width=max(float(at[1][k] - at[0][k]), 0.4),
                nominal_at=float(at[2][k]),
                estimate_at=float(at[3][k]),
                prior=prior,
            )
        )
    return rows


def heldout_rows(rmse: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, str, list[float | None]]]]:
    """Return the predictors, and for each joint and their mean the unit and each predictor's error.

    An error is None where a prediction diverged. The sensor's noise follows where it is known. The mean is
    left out where joints have different units. ``rmse`` is ``provenance.heldout_rmse``.
    """
    by_joint, noise = _mapping(rmse.get("by_coordinate")), _mapping(rmse.get("noise"))
    means = _mapping(rmse.get("mean"))
    if noise.get("mean") is not None:
        by_joint, means = by_joint | {"noise": noise["by_coordinate"]}, means | {"noise": noise["mean"]}
    names, units = list(by_joint), _mapping(rmse.get("unit"))
    joints = list(_mapping(by_joint[names[0]])) if names else []
    rows = [(joint, units.get(joint, ""), [by_joint[name][joint] for name in names]) for joint in joints]
    same = {units.get(joint, "") for joint in joints}
    if len(joints) > 1 and len(same) == 1:
        rows.append(("mean", same.pop(), [means.get(name) for name in names]))
    return names, rows


def advice_rows(result: CalibrationResult) -> list[dict[str, str]]:
    """Return the table of advised recordings, in words."""

    def spread(row: Mapping[str, Any], key: str) -> str:
        return "–" if row[key] is None else std_words(result.space[row["parameter"]], row[key])

    return [
        {
            "parameter": str(row["parameter"]),
            "before": spread(row, "std"),
            "after": spread(row, "std_after") if row["excitation"] else "–",
            "sentence": str(row["sentence"]),
        }
        for row in result.advice
    ]


def short(value: float, digits: int = 4) -> str:
    """Format a number with so many digits."""
    return f"{value:.{digits}g}" if math.isfinite(value) else "–"


@dataclass(frozen=True, slots=True)
class ComparedFit:
    """A candidate of the cross-validation.

    Attributes:
        name: Its name: the length of its windows, and what it has that others lack.
        errors: Its error in each fold, in units of the sensor's noise.
        ratio: Its error over that of the chosen one, geometric mean of the folds.
        chosen: Whether it was chosen.
    """

    name: str
    errors: tuple[float, ...]
    ratio: float
    chosen: bool


def compared_fits(choice: Mapping[str, Any]) -> list[ComparedFit]:
    """Return the candidates of a cross-validation, best first; nothing where none were compared.

    Args:
        choice: :meth:`deal_hw.calib.data.folds.Choice.to_json`.
    """
    errors, chosen = _mapping(choice.get("errors")), choice.get("chosen")
    if chosen not in errors:
        return []

    def mean(name: str) -> float:
        return float(np.exp(np.mean(np.log(errors[name]))))

    return [
        ComparedFit(name, tuple(errors[name]), mean(name) / mean(chosen), name == chosen)
        for name in sorted(errors, key=mean)
    ]


JUDGED = {
    "fit": "a fit to a part of the recordings",
    "effect": "its effect around the fit",
    "likelihood": "the residual's likelihood",
    "folds": "a fit in every fold",
}
OUTCOMES = {
    "taken": "in this result",
    "named": "named",
    "not named": "not named",
    "chance": "no better than without it",
}
"""How a candidate explanation was judged, and what became of it, in words."""
LEAST_SHOWN, LEAST_GAIN = 1e-3, 1.0
"""Smaller shares and gains in deviance of a candidate are shown as none [-]."""


def candidate_rows(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the table of candidate explanations, in words.

    Args:
        found: :meth:`deal_hw.calib.hypotheses.candidates.Candidate.to_json` of each.
    """
    return [
        {
            "explanation": row["explanation"],
            "judged": JUDGED[row["judged"]],
            "share": "–" if (row["share"] or 0.0) < LEAST_SHOWN else percent(row["share"]),
            "deviance": "–" if (row["deviance"] or 0.0) < LEAST_GAIN else short(row["deviance"], 3),
            "outcome": OUTCOMES[row["outcome"]],
            "taken": row["outcome"] == "taken",
        }
        for row in found
    ]


def _mapping(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, dict) else {}


def _plain(value: Any) -> str:
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)


def write_result(
    folder: Path, robot: RobotModel, result: CalibrationResult, report: ReportInputs | None = None
) -> dict[str, Path]:
    """Write everything a calibration found; all of it appears, or none. A report of None is not written.

    Return the files by name; changed included files of the model are among them.

    Raises:
        DatasetError: The folder cannot be written.
        ModelNotWrittenError: A calibrated value cannot be written into the model.
        KeyboardInterrupt: Ctrl-C; nothing was changed, or all files are there.
    """
    unwritable = ""
    names = [RESULT_FILE, DISTRIBUTION, TRACE]
    with _published(folder) as waiting:
        judged = _write_numbers(waiting, robot, result)
        np.savez(waiting / TRACE, **_trace(result))
        if report is not None:
            write_report(waiting / REPORT, report)
            names.append(REPORT)
        names += write_exports(waiting, robot, result, judged)
        try:
            require_other(folder / MODEL, robot.description.mjcf)
            written = write_model(robot, result, waiting / MODEL)
            names += [file.name for file in written]
            names += _write_plain(result, waiting)
        except ConfigurationError as err:
            # An error in the model must not cost the numbers.
            unwritable = str(err).replace(str(waiting), str(folder))
    files = {name: folder / name for name in names}
    if unwritable:
        raise ModelNotWrittenError(unwritable, files)
    return files


def write_numbers(folder: Path, robot: RobotModel, result: CalibrationResult) -> dict[str, Path]:
    """Write a result's numbers alone, both files or none; otherwise as :func:`write_result`."""
    with _published(folder) as waiting:
        _write_numbers(waiting, robot, result)
    return {name: folder / name for name in (RESULT_FILE, DISTRIBUTION)}


@contextlib.contextmanager
def _published(folder: Path) -> Iterator[Path]:
    try:
        with published_together(folder) as waiting:
            yield waiting
    except OSError as err:
        raise DatasetError(f"{folder} cannot be written: {err.strerror}") from err


def _write_numbers(folder: Path, robot: RobotModel, result: CalibrationResult) -> dict[str, str]:
    """Write result and distribution, and return the verdict that both carry."""
    found = trust(result)
    judged = {"verdict": found.colour, "verdict_reason": found.sentence}
    write_json(folder / RESULT_FILE, result.to_json() | judged)
    write_json(folder / DISTRIBUTION, model_distribution(robot, result).to_json() | judged)
    return judged


def model_distribution(robot: RobotModel, result: CalibrationResult) -> ParameterDistribution:
    """Return the calibrated distribution of the parameters that act on the robot's own model.

    A payload is in a set-up only, and what an effort sensor reports moves nothing. Both are in the result,
    but no policy is trained with them. Where recordings had zeros of their own, the next one's is unknown.
    """
    here = robot.acting(result.space)
    sensors = [kind.name for kind in EFFORT_KINDS]
    idle = (p.name for p in here.parameters if not p.elements or p.kind in sensors)
    more = next_zeros(result.space, result.estimate)
    return result.distribution().without(idle).with_more(*more)


def write_model(robot: RobotModel, result: CalibrationResult, path: Path) -> tuple[Path, ...]:
    """Write the calibrated MJCF, with the physics step of the fit; see :func:`write_calibrated_mjcf`."""
    step_s = result.provenance.get("fit_step_s")
    return write_calibrated_mjcf(
        robot if step_s is None else at_step(robot, step_s),
        result.space,
        result.estimate,
        path,
        result.latency_s,
        f"method {result.method}, distribution {model_distribution(robot, result).digest()}",
        result.without_value,
        trust(result).colour,
        result.biased,
    )


def _write_plain(result: CalibrationResult, folder: Path) -> list[str]:
    """Write the calibrated model for MuJoCo alone beside the calibrated one; return its files' names.

    There is none where it could not be made, and of an interrupted calibration.
    """
    facts = result.provenance.get(FACTS, {"error": "interrupted"})
    if "error" in facts:
        return []
    words = difference_words(facts)
    made = write_plain_mjcf(
        folder / MODEL,
        folder / PLAIN_MODEL,
        bristles=facts["bristles"],
        remarks=[words] if words else [],
    )
    return [file.name for file in made.files]


def _trace(result: CalibrationResult) -> dict[str, Any]:
    keys = sorted({key for row in result.trace for key in row})
    columns: dict[str, Any] = {key: np.array([row.get(key, np.nan) for row in result.trace]) for key in keys}
    if result.population is not None:
        columns["population"] = result.population
    return columns
