"""What is checked once the polish has ended: agreement of halves, the look of an unexplained residual."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished
from deal_hw.calib.uncertainty.intervals import (
    MISMATCH_CHI2,
    MISMATCH_TIME,
    NEGLIGIBLE_CHI2,
    Uncertainty,
    correlation_time,
    ended_at_bound,
)
from deal_hw.calib.uncertainty.physics_step import check_step, counted, step_alarm
from deal_hw.calib.validation.diagnosis import Finding, diagnose, motions
from deal_hw.calib.validation.split_half import compare_halves, heed
from deal_hw.calibration import Alarm
from deal_hw.parameters import LONGEST_LATENCY_S
from deal_hw.types import FloatArray

AT_END = 0.01
"""A latency ended at the end of its range where it is within this share of it."""
MOST_CAUSES = 2
"""So many causes are worded in alarms; all are in the provenance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """Which checks follow a polish."""

    local_first: bool = True
    """Refine the model's own values first; where that explains the recordings there is no search."""

    folds: bool = True
    """Where the residual is unexplained, keep the polish only if it predicts better on inner folds."""

    robust: bool = False
    """Try Huber's loss on those folds, too, where the residual has heavy tails."""

    halves: bool = True
    """Polish two halves of the data alone and compare."""

    physics_step: bool = True
    """Predict with half the physics step; intervals count what the step moves."""

    diagnosis: bool = True
    """Say what an unexplained residual looks like."""


def latency_alarms(problem: Problem, latency_s: float) -> tuple[Alarm, ...]:
    """Return an alarm where a latency that was searched ended at the end of its range.

    The lower end counts where it is above zero.

    Args:
        problem: The problem.
        latency_s: The estimate [s].
    """
    if problem.fixed_latency_s is not None:
        return ()
    low, high = problem.latency_range_s
    near = max(AT_END * (high - low), 0.5 * problem.episodes[0].step_s)
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
            f"The robot may act {side} than that; then other parameters make up for it.",
            f"Calibrate again with --latency-range {wider[0]:g} {wider[1]:g}.",
        ),
    )


def unexplained(polished: Polished) -> bool:
    """Return whether the residual is larger, or hangs together longer, than noise does."""
    if polished.chi2 <= NEGLIGIBLE_CHI2:
        return False
    return polished.chi2 > MISMATCH_CHI2 or correlation_time(polished.normal.residual) > MISMATCH_TIME


def judge(
    problem: Problem, polished: Polished, known: Uncertainty, settings: Validation
) -> tuple[Uncertainty, dict[str, Any]]:
    """Check and return what is then known, and facts for the provenance.

    Args:
        problem: The problem.
        polished: Where the polish ended, with linearised residuals.
        known: What is known there.
        settings: Which checks.
    """
    facts: dict[str, Any] = {"inflation": known.inflation}
    ended = np.flatnonzero(ended_at_bound(problem.space, polished.theta))
    facts["at_bound"] = [problem.space.names[k] for k in ended]
    if known.clustered is not None:
        cluster = known.clustered
        facts["clustered"] = {
            "blocks": cluster.blocks,
            "block_s": cluster.block_samples * problem.episodes[0].period_s,
            "variance_ratio": dict(zip(problem.space.names, map(float, cluster.ratio), strict=False)),
            "widened": dict(zip(problem.space.names, map(float, known.widened), strict=True)),
        }
    if settings.physics_step:
        known, facts["physics_step"] = with_step(problem, polished, known, polished.theta)
    if settings.halves:
        halves = compare_halves(problem, polished, known)
        known = heed(problem, known, polished.theta, halves)
        facts["halves"] = halves.to_json()
    if settings.diagnosis and unexplained(polished):
        known, facts["diagnosis"] = with_causes(problem, polished, known)
    return known, facts


def with_step(
    problem: Problem, polished: Polished, known: Uncertainty, theta: FloatArray
) -> tuple[Uncertainty, dict[str, Any]]:
    """Return what is known, the physics step counted, and what the check found, as plain JSON values.

    Args:
        problem: The problem.
        polished: Where a fit of windows ended, with linearised residuals.
        known: What was known before.
        theta: The estimate that is about, (K,).
    """
    step = check_step(problem, polished)
    alarms = step_alarm(problem, known, step)
    known = counted(problem, known, theta, step)
    return dataclasses.replace(known, alarms=(*known.alarms, *alarms)), step.to_json()


def with_causes(
    problem: Problem, polished: Polished, known: Uncertainty
) -> tuple[Uncertainty, list[dict[str, Any]]]:
    """Return what is known, alarmed by what the residual looks like, and all causes as plain JSON values."""
    found = diagnosed(problem, polished, known)
    alarms = (f.alarm for f in found[:MOST_CAUSES])
    return dataclasses.replace(known, alarms=(*known.alarms, *alarms)), [dataclasses.asdict(f) for f in found]


def diagnosed(problem: Problem, polished: Polished, known: Uncertainty) -> tuple[Finding, ...]:
    """Return what the residual looks like."""
    free = np.append(known.shape.bound == 0, known.latency_interval_s[0] != known.latency_interval_s[1])
    hessian = polished.normal.hessian * np.outer(free, free)
    return diagnose(
        motions(problem, polished),
        hessian,
        problem.robot.description.joint_names,
        correlation_time(polished.normal.residual),
    )
