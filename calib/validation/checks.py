"""Checks after a fit: which ones run, what they change of its uncertainty, and what they report."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH, Uncertainty, correlation_time, names_at_bound
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.validation.diagnosis import PlayFit, diagnose
from deal_hw.calib.validation.split_half import check_split_half, widened_by_split_half
from deal_hw.calib.validation.time_steps import check_step, counted, step_alarm
from deal_hw.calibration import Alarm
from deal_hw.parameters import LONGEST_LATENCY_S


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckSettings:
    """Settings of the checks.

    Attributes:
        at_end: Distance to an end of the latency range, as a share of it, that counts as at the end [-].
        causes: Most causes of a residual that become alarms; all are in the provenance.
    """

    at_end: float = 0.01
    causes: int = 2


SETTINGS = CheckSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """Which checks follow a refinement."""

    local_first: bool = True
    """Refine the nominal values first; where that explains the recordings there is no search."""

    cross_validation: bool = True
    """Where the residual is unexplained, keep the refinement only if it predicts better on inner folds."""

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
        known, facts["physics_step"] = with_step(problem, refined, known)
    if settings.split_half:
        split = check_split_half(problem, refined, known)
        known = widened_by_split_half(known, split)
        facts["split_half"] = split.to_json()
    if settings.diagnosis and unexplained(refined):
        known, facts["diagnosis"] = with_causes(problem, refined, known, fitted)
    return known, facts


def with_step(problem: Problem, refined: Refined, known: Uncertainty) -> tuple[Uncertainty, dict[str, Any]]:
    """Check the physics step; return the updated uncertainty and the result as plain JSON values.

    ``refined`` has linearised residuals.
    """
    step = check_step(problem, refined)
    alarms = step_alarm(known, step)
    return counted(problem, known, step).with_alarms(last=alarms), step.to_json()


def with_causes(
    problem: Problem, refined: Refined, known: Uncertainty, fitted: PlayFit | None = None
) -> tuple[Uncertainty, list[dict[str, Any]]]:
    """Put alarms for causes of the residual first; return all causes as plain JSON values, too."""
    found = diagnose(problem, refined, fitted)
    alarms = (f.alarm for f in found[: SETTINGS.causes])
    return known.with_alarms(*alarms), [dataclasses.asdict(f) for f in found]
