"""Checks after a fit, and the verdict on its use in one colour; the held-out error decides first."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.validation.diagnosis import PlayFit, diagnose
from deal_hw.calib.validation.intervals import MISMATCH, Uncertainty, correlation_time, names_at_bound
from deal_hw.calib.validation.split_half import check_split_half, widened_by_split_half
from deal_hw.calib.validation.time_steps import check_step, counted, step_alarm
from deal_hw.calibration import Alarm, CalibrationResult, percent
from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.types import FloatArray

Colour = Literal["green", "amber", "red"]


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictSettings:
    """Settings of the checks and of :func:`trust`.

    Attributes:
        worse: Ratio to the nominal model's held-out error above which a result is worse [-]: less is chance
            where the nominal model was right.
        at_end: Distance to an end of the latency range, as a share of it, that counts as at the end [-].
        causes: Most causes of a residual that become alarms; all are in the provenance.
    """

    worse: float = 1.02
    at_end: float = 0.01
    causes: int = 2


SETTINGS = VerdictSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """Which checks follow a refinement."""

    local_first: bool = True
    """Refine the nominal values first; where that explains the recordings there is no search."""

    cross_validation: bool = True
    """Where the residual is unexplained, keep the refinement only if it predicts better on inner folds."""

    robust: bool = False
    """Try Huber's loss on those folds, too, where the residual has heavy tails."""

    split_half: bool = True
    """Refine two halves of the data alone and compare."""

    physics_step: bool = True
    """Predict with half the physics step; intervals include the step's shift."""

    diagnosis: bool = True
    """Name causes of an unexplained residual."""


def latency_alarms(problem: Problem, latency_s: float) -> tuple[Alarm, ...]:
    """Return an alarm where a searched latency ended at an end of its range; zero is no such end."""
    if problem.fixed_latency_s is not None:
        return ()
    low, high = problem.latency_range_s
    near = max(SETTINGS.at_end * (high - low), 0.5 * problem.episodes[0].step_s)
    if latency_s > high - near:
        side, wider = "later", (low, min(2 * high, LONGEST_LATENCY_S))
    elif low > 0 and latency_s < low + near:
        side, wider = "sooner", (0.0, high)
    else:
        return ()
    return (
        Alarm(
            f"The latency ended at {1e3 * latency_s:.3g} ms, the end of what was searched ({1e3 * low:g} to "
            f"{1e3 * high:g} ms).",
            f"The robot may act {side} than that; then other parameters compensate for it.",
            f"Calibrate again with --latency-range {wider[0]:g} {wider[1]:g}.",
        ),
    )


def unexplained(refined: Refined, longest: float = MISMATCH.correlation_samples) -> bool:
    """Return whether the residual exceeds noise, or is autocorrelated over more than ``longest`` samples."""
    if refined.chi2 <= MISMATCH.negligible_chi2:
        return False
    if refined.chi2 > MISMATCH.chi2:
        return True
    return correlation_time(refined.normal.residual) > longest


def judge(
    problem: Problem,
    refined: Refined,
    known: Uncertainty,
    settings: Validation,
    fitted: PlayFit | None = None,
) -> tuple[Uncertainty, dict[str, Any]]:
    """Run the checks; return the updated uncertainty and facts for the provenance.

    ``refined`` has linearised residuals, and ``known`` is its uncertainty. ``fitted`` is a fit with play.
    """
    facts: dict[str, Any] = {
        "inflation": known.inflation,
        "at_bound": names_at_bound(problem.space, refined.theta),
    }
    if known.clustered is not None:
        cluster = known.clustered
        facts["clustered"] = {
            "blocks": cluster.blocks,
            "block_s": cluster.block_samples * problem.episodes[0].period_s,
            "variance_ratio": dict(zip(problem.space.names, map(float, cluster.ratio), strict=False)),
            "widened": dict(zip(problem.space.names, map(float, known.widened), strict=True)),
        }
    if settings.physics_step:
        known, facts["physics_step"] = with_step(problem, refined, known, refined.theta)
    if settings.split_half:
        split = check_split_half(problem, refined, known)
        known = widened_by_split_half(problem, known, refined.theta, split)
        facts["split_half"] = split.to_json()
    if settings.diagnosis and unexplained(refined):
        known, facts["diagnosis"] = with_causes(problem, refined, known, fitted)
    return known, facts


def with_step(
    problem: Problem, refined: Refined, known: Uncertainty, theta: FloatArray
) -> tuple[Uncertainty, dict[str, Any]]:
    """Check the physics step; return the updated uncertainty and the result as plain JSON values.

    ``refined`` has linearised residuals; ``theta``, (K,), is the estimate of ``known``.
    """
    step = check_step(problem, refined)
    alarms = step_alarm(problem, known, step)
    known = counted(problem, known, theta, step)
    return dataclasses.replace(known, alarms=(*known.alarms, *alarms)), step.to_json()


def with_causes(
    problem: Problem, refined: Refined, known: Uncertainty, fitted: PlayFit | None = None
) -> tuple[Uncertainty, list[dict[str, Any]]]:
    """Put alarms for causes of the residual first; return all causes as plain JSON values, too."""
    found = diagnose(problem, refined, fitted)
    alarms = (f.alarm for f in found[: SETTINGS.causes])
    return dataclasses.replace(known, alarms=(*alarms, *known.alarms)), [dataclasses.asdict(f) for f in found]


@dataclass(frozen=True, slots=True)
class Trust:
    """The verdict on the use of a calibration.

    Attributes:
        colour: Green: use it. Amber: it has a known weakness. Red: do not use it.
        seen: What was seen.
        means: What it means.
        do: What to do.
    """

    colour: Colour
    seen: str
    means: str
    do: str

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        return f"{self.seen} {self.means} {self.do}"


def trust(result: CalibrationResult) -> Trust:
    """Return whether a result can be used."""
    nominal, calibrated = (result.heldout_nrmse.get(name) for name in ("nominal", "calibrated"))
    noise = (
        f"Residuals are {math.sqrt(result.chi2):.1f} times the sensor's noise." if result.chi2 >= 0 else ""
    )
    mismatch = result.chi2 > MISMATCH.chi2
    if "shared_error" in result.provenance:
        first = result.alarms[0]
        return Trust("red", first.seen, first.means, f"Do not use it. {first.do}")
    if nominal is None or calibrated is None:
        record = "Record one more motion and name it with --holdout."
        if mismatch:
            means = "The model does not explain them, and no held-out recording shows whether it is better."
            return Trust("red", noise, means, f"Do not use it. {record}")
        gain = "There is no held-out recording."
    elif not calibrated <= SETTINGS.worse * nominal:
        return Trust(
            "red",
            f"On held-out motion the calibrated model errs by {percent(calibrated)} of the signal's "
            "range, your "
            f"own model by {percent(nominal)}.",
            "The calibrated model is worse.",
            "Do not use it. Check units, signs and joint order of the recordings, then the alarms.",
        )
    else:
        record = ""
        smaller = nominal / max(calibrated, 1e-300)
        gain = f"On held-out motion the error is {smaller:.1f} times smaller than your own model's."
    if mismatch:
        return Trust(
            "amber",
            f"{gain} {noise}",
            "The model is better than yours, but it lacks something that the robot has.",
            "Use it, but trust predictions more than single values."
            + (" The first alarm names the likely cause." if result.provenance.get("diagnosis") else ""),
        )
    if result.alarms:
        many = len(result.alarms)
        count, read = (
            (f"There are {many} alarms.", "Read them") if many > 1 else ("There is 1 alarm.", "Read it")
        )
        return Trust(
            "amber",
            f"{gain} {count}",
            "The result has a known weakness.",
            f"{read} before you use the result.",
        )
    if math.isnan(result.chi2):
        return Trust(
            "amber",
            gain,
            "The method does not test whether the model explains the recordings.",
            f"Compare the held-out error with the error that your task allows. {record}".strip(),
        )
    unidentified = result.verdicts.count("not identifiable")
    if result.null_directions or unidentified:
        advised = " Or record the motion advised below." if result.advice else ""
        if not unidentified:
            return Trust(
                "amber",
                f"{gain} {noise}",
                "The model explains the recordings, but they hardly tell some parameters apart.",
                f"Use it. To narrow intervals, measure one of the parameters named together below.{advised}",
            )
        return Trust(
            "amber",
            f"{gain} {noise} {unidentified} of {len(result.space)} parameters have no value.",
            "The model explains the recordings, but they do not identify all parameters.",
            f"Use it: training draws these parameters from their whole range.{advised}",
        )
    if record:
        return Trust(
            "amber", f"{gain} {noise}", "No recording shows whether the model holds on other motion.", record
        )
    return Trust("green", f"{gain} {noise}", "The remaining error is the sensor's noise.", "Use it.")
