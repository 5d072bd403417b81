"""Checks after a fit: which ones run, what they change of its uncertainty, and what they report.

Split-half check: two halves of the data, each fitted alone from the estimate on all, must agree. The halves
are alternating blocks of the refinement's own windows. So no sample is predicted in both, and both hold every
phase of the motion. The fit of a half is one step in residuals that are linearised already.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from deal_hw.calib.data.parts import taken
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import (
    CORRELATION_SAMPLES,
    MISMATCH_CHI2,
    NEGLIGIBLE_CHI2,
    Uncertainty,
    correlation_time,
    latency_end,
    names_at_bound,
    uncertainty_at,
    wider_latency,
    with_rows,
)
from deal_hw.calib.fit.one_step import of_rows, one_step
from deal_hw.calib.fit.refinement import LOCAL_HOPELESS, Refined, refine_windows, refined_at
from deal_hw.calib.fit.residual import Point, Shooting, WindowRows
from deal_hw.calib.fit.unexplained import Unexplained
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.diagnosis import all_allowed, diagnose
from deal_hw.calib.hypotheses.thresholds import MOST_ALARMS, NEAR_CHI2
from deal_hw.calib.hypotheses.trials import Allows, Tried
from deal_hw.calib.validation.residual_place import residual_place
from deal_hw.calib.validation.settings import Validation
from deal_hw.calib.validation.time_steps import check_step, counted, step_alarm
from deal_hw.calibration import LATENCY, Z90, listed
from deal_hw.findings import Finding, SafeChecks
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

HALF_ITERATIONS = 6
"""Most iterations of each half's fit."""

FEWEST_WINDOWS = 4
"""Fewest windows that are halved."""

SPLIT_FALSE_ALARMS = 0.05
"""Probability that the split-half check flags any parameter of a right model [-]: among many parameters,
intervals of some halves always miss each other."""


UNKNOWN = "None of the known causes explains them."
TOO_FAR = (
    f"That is too far to name a cause: the limit is {np.sqrt(NEAR_CHI2):.0f} times the noise, and no known "
    "law brings the fit there."
)
"""Why no cause is named."""

HALVES = "two halves of the data"
PHYSICS_STEP = "the physics step"
CAUSES = "causes of the residual"
"""Names of checks."""


def latency_alarms(
    problem: Problem, latency_s: float, searched_s: tuple[float, float] | None = None
) -> tuple[Finding, ...]:
    """Return an alarm where a searched latency ended at an end of its range; zero is no such end.

    Args:
        problem: The problem.
        latency_s: The latency [s].
        searched_s: Its range at last [s]; None: the problem's.
    """
    low, high = searched_s or problem.latency_range_s
    end = latency_end(problem, latency_s, (low, high))
    if not end:
        return ()
    side, wider = "later" if end > 0 else "sooner", wider_latency((low, high), end)
    return (
        Finding.alarm(
            f"The latency ended at {1e3 * latency_s:.3g} ms, the end of what was searched ({1e3 * low:g} to "
            f"{1e3 * high:g} ms).",
            f"The robot may act {side} than that; then other parameters compensate for it.",
            f"Calibrate again with --latency-range {wider[0]:g} {wider[1]:g}.",
        ),
    )


def unexplained(refined: Refined, longest: float = CORRELATION_SAMPLES, chance: float | None = None) -> bool:
    """Return whether the residual exceeds noise, or is autocorrelated over more than ``longest`` samples.

    With a ``chance``, it has to be longer beyond that chance.
    """
    if refined.chi2 <= NEGLIGIBLE_CHI2:
        return False
    if refined.chi2 > MISMATCH_CHI2:
        return True
    return correlation_time(refined.normal.residual, chance, refined.normal.periods_s) > longest


def doubtful(refined: Refined) -> bool:
    """Return whether noise does not explain a fit, in its own windows or in longer ones.

    Noise does not grow with a window's length, and a model's error does.
    """
    return unexplained(refined) or refined.refused is not None


def hold_windows(known: Uncertainty, latency_s: float, fit: Refined) -> Uncertainty:
    """Return ``known`` of a model that is wrong, with intervals that hold what other windows say.

    A model's error adds up along a window. So estimates of a wrong model change with the window's length, by
    more than their own uncertainty, which alone is no reason (Hausman 1978). Every part of the recordings
    shares that error: it shows neither in their halves nor in blocks of time. Shorter windows are easier to
    explain; those with a larger residual ended in another minimum, and do not count. Longer windows that were
    refused count, if their residual is not so large that they ended elsewhere, too.

    Args:
        known: The uncertainty of an estimate.
        latency_s: Its latency [s].
        fit: The estimate's fit, or that from which it began, with shorter ones and a refused one.
    """
    space, problem = known.space, fit.shooting.problem
    others: list[Refined] = []
    longer, shorter = fit, fit.shorter
    while shorter is not None and _chi2_as(shorter, longer) < longer.chi2:
        others.append(shorter)
        longer, shorter = shorter, shorter.shorter
    if fit.refused is not None and fit.refused.chi2 < LOCAL_HOPELESS * max(fit.chi2, 1.0):
        others.append(fit.refused)
    # A law that was taken on top of these fits has parameters that they do not have.
    K, fitted = len(problem.space), np.r_[: len(problem.space), -1]
    excess = np.zeros(len(space) + 1)
    for other in others:
        own = uncertainty_at(problem, other)
        late_std = own.latency_reach_s(other.latency_s) / Z90
        std = np.append(np.sqrt(np.diag(own.covariance)), late_std)
        moved = problem.space.to_scale(other.theta) - problem.space.to_scale(known.theta[:K])
        square = np.append(moved, other.latency_s - latency_s) ** 2
        excess[fitted] = np.maximum(excess[fitted], np.sqrt(np.maximum(square - std**2, 0.0)))
    excess[:-1][known.blind] = 0.0
    wider = known.widened_to(np.sqrt(np.diag(known.covariance)) + excess[:-1] / Z90)
    if reach_s := known.latency_reach_s(latency_s):
        wider = wider.latency_widened_to(reach_s + excess[-1], latency_s, problem.latency_range_s)
    return wider


def hold_alike(
    problem: Problem, known: Uncertainty, latency_s: float, shifts: Sequence[FloatArray]
) -> tuple[Uncertainty, dict[str, float]]:
    """Return ``known`` with intervals that hold what other models say that predict as well.

    Each of the models is as likely. So their values are spread around the estimate by the mean of s s^T, with
    the shift s of each, 0 for the estimate's own. Values that only go up and down together do so in the
    covariance, too: drawn robots then move alike. Recordings like these do not take that away, so the
    standard deviations that it adds are returned, too, in each parameter's own scale.

    Args:
        problem: The problem.
        known: The uncertainty of an estimate.
        latency_s: Its latency [s].
        shifts: Where each of the others puts the values, in their scales, and the latency [s], (K + 1,).
    """
    every = np.array(shifts) * np.append(~known.blind, True)
    spread, most = every.T @ every / (len(every) + 1), np.max(np.abs(every), axis=0)
    wider = known.with_covariance(known.covariance + spread[:-1, :-1]).widened_to(most[:-1] / Z90)
    added = np.sqrt(np.maximum(np.diag(wider.covariance) - np.diag(known.covariance), 0.0))
    if reach_s := known.latency_reach_s(latency_s):
        wider = wider.latency_widened_to(reach_s + most[-1], latency_s, problem.latency_range_s)
    return wider, dict(zip(known.space.names, map(float, added), strict=True))


def _chi2_as(fit: Refined, other: Refined) -> float:
    """Return a fit's chi2 with the channels' weights of another."""
    ratio = fit.shooting.problem.noise.position_std / other.shooting.problem.noise.position_std
    every = np.concatenate([r.reshape(-1, r.shape[-1]) for r in fit.normal.residual])
    return float(fit.chi2 * np.sum((every * ratio) ** 2) / max(np.sum(every**2), 1e-300))


def judge(
    problem: Problem,
    refined: Refined,
    known: Uncertainty,
    settings: Validation,
    tried: Sequence[Tried] = (),
    allows: Allows = all_allowed,
    *,
    safely: SafeChecks,
    plain: Refined | None = None,
) -> tuple[Uncertainty, dict[str, Any]]:
    """Run the checks; return the updated uncertainty and facts for the provenance.

    The physics step and the causes of the residual come first, because they say what to do. A check that
    raises changes nothing.

    Args:
        problem: The problem.
        refined: Its fit, with linearised residuals.
        known: The fit's uncertainty.
        settings: Which checks to run.
        tried: Laws that the model may lack, which were tried.
        allows: Which of the long ones may run.
        safely: Runs them, and notes those that fail.
        plain: The fit by least squares whose residual is judged, where the fit allows for random errors.
    """
    plain = plain or refined
    facts: dict[str, Any] = {
        "inflation": known.inflation,
        "at_bound": names_at_bound(problem.space, refined.theta),
    }
    if known.clustered is not None:
        cluster = known.clustered
        facts["clustered"] = {
            "blocks": cluster.blocks,
            "block_s": cluster.block_windows * refined.shooting.length * problem.period_s,
            "variance_ratio": dict(zip(problem.space.names, map(float, cluster.ratio), strict=False)),
            "widened": dict(zip(problem.space.names, map(float, known.widened), strict=True)),
        }
    if settings.physics_step:
        known, step = safely.run(PHYSICS_STEP, (known, {}), with_step, problem, refined, known)
        facts |= {"physics_step": step} if step else {}
    found = None
    if settings.diagnosis and unexplained(plain):
        found = safely.run(CAUSES, None, diagnose, problem, with_rows(plain), tried, allows)
    if settings.split_half:
        split = safely.run(HALVES, FAILED, check_split_half, problem, refined, known, allows)
        known = widened_by_split_half(known, split, refined.latency_s, problem.latency_range_s)
        facts["split_half"] = split.to_json()
    if found is not None:
        known = with_unsure(problem, refined, known, found.unsure)
        known, facts["diagnosis"] = with_causes(problem, plain, known, found.causes)
        facts["candidates"] = [one.to_json() for one in found.candidates]
    return known, facts


def with_step(problem: Problem, refined: Refined, known: Uncertainty) -> tuple[Uncertainty, dict[str, Any]]:
    """Check the physics step; return the updated uncertainty and the result as plain JSON values.

    ``refined`` has linearised residuals. Far from the recordings a finer step is no reason for an alarm.
    """
    step = check_step(problem, refined)
    alarms = step_alarm(known, step) if refined.chi2 <= NEAR_CHI2 else ()
    return counted(problem, known, step).with_alarms(last=alarms), step.to_json()


def with_causes(
    problem: Problem, refined: Refined, known: Uncertainty, found: Sequence[Diagnosis]
) -> tuple[Uncertainty, list[dict[str, Any]]]:
    """Put alarms for causes of the residual first; return all causes as plain JSON values, too.

    Where there is none, the alarm says why, and where the residual lies.
    """
    alarms: list[Finding] = list(found[:MOST_ALARMS])
    if not found and refined.chi2 > MISMATCH_CHI2:
        why = UNKNOWN if refined.chi2 <= NEAR_CHI2 else TOO_FAR
        alarms = [Unexplained.larger(refined.chi2, place=f"{why} {residual_place(problem, refined)}")]
    return biased(problem, known, found).with_alarms(*alarms), [f.to_json() for f in found]


def with_unsure(problem: Problem, refined: Refined, known: Uncertainty, unsure: FloatArray) -> Uncertainty:
    """Return ``known`` with intervals widened by what causes that are not named may have moved.

    Args:
        problem: The problem.
        refined: Its fit.
        known: The fit's uncertainty.
        unsure: Standard deviation of the shift, (K + 1,), as :class:`Diagnosed` has it; empty for none.
    """
    if not len(unsure):
        return known
    variance = np.diag(known.covariance) + unsure[:-1] ** 2
    known = known.widened_to(np.where(known.blind, 0.0, np.sqrt(variance)))
    if problem.fixed_latency_s is not None:
        return known
    wider_s = float(np.hypot(known.latency_reach_s(refined.latency_s), Z90 * unsure[-1]))
    return known.latency_widened_to(wider_s, refined.latency_s, problem.latency_range_s)


def biased(problem: Problem, known: Uncertainty, causes: Sequence[Diagnosis]) -> Uncertainty:
    """Return ``known`` with intervals widened by the shift of each cause, and marks on what it moves.

    A cause moves a value that would leave its interval, or that ended at a bound which the data press. Such a
    value compensates for the cause.
    """
    if not causes:
        return known
    K = len(known.space)
    std = np.sqrt(np.diag(known.covariance))
    shifts = [np.zeros(K + 1) if not len(c.shift) else np.abs(c.shift) for c in causes]
    total = np.sum(shifts, axis=0)
    marks = dict(known.biased)
    for k, name in enumerate(known.space.names):
        most = int(np.argmax([shift[k] for shift in shifts]))
        if total[k] > Z90 * std[k] or known.bound[k]:
            marks[name] = causes[most].code
    known = dataclasses.replace(known.widened_to(std + total[:K] / Z90), biased=marks)
    if problem.fixed_latency_s is not None or not total[-1]:
        return known
    (first, last), (low, high) = problem.latency_range_s, known.latency_interval_s
    if total[-1] > max((high - low) / 2, 0.5 * problem.step_s):
        marks[LATENCY] = causes[int(np.argmax([shift[-1] for shift in shifts]))].code
    wider = (max(low - total[-1], first), min(high + total[-1], last))
    return dataclasses.replace(known, latency_interval_s=wider, biased=marks)


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitHalfRow:
    """One parameter's estimates from two halves of the data.

    Attributes:
        name: The parameter, or "latency" [s].
        first: Estimate and 90 % interval (low, high) of one half. The estimate is None where that half does
            not identify the parameter: the interval is then the range's own.
        second: The same of the other half.
    """

    name: str
    first: tuple[float | None, float, float]
    second: tuple[float | None, float, float]

    @property
    def agree(self) -> bool | None:
        """Whether the intervals overlap; None where a half does not identify the parameter."""
        if self.first[0] is None or self.second[0] is None:
            return None
        return self.first[1] <= self.second[2] and self.second[1] <= self.first[2]


@dataclass(frozen=True, slots=True)
class SplitHalf:
    """Result of the split-half check.

    Attributes:
        rows: One per parameter, and one of a searched latency; empty without a comparison.
        flagged: Those that differ by more than chance.
        reach: Largest distance of a half's estimate from that on all data, in each parameter's own scale,
            and of the latency [s], (K + 1,).
        scale: Factor on all standard deviations: the root mean square distance of the halves over that which
            the intervals expect. 1 where chance explains the distance. Tables of particle data use the same
            factor where measurements disagree.
        steps: Physics steps used.
        note: Why nothing was compared.
    """

    rows: tuple[SplitHalfRow, ...] = ()
    flagged: tuple[str, ...] = ()
    reach: FloatArray = field(default_factory=lambda: np.zeros(0))
    scale: float = 1.0
    steps: int = 0
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        if not self.rows:
            return {"note": self.note}
        return {
            "parameters": {
                r.name: {"first": list(r.first), "second": list(r.second), "agree": r.agree}
                for r in self.rows
            },
            "flagged": list(self.flagged),
            "scale": self.scale,
            "steps": self.steps,
        }

    def alarms(self, space: ParameterSpace) -> tuple[Finding, ...]:
        """Return one alarm that names all flagged parameters, if there are any."""
        if not self.flagged:
            return ()
        both = {}
        for r in self.rows:
            unit, scale = ("ms", 1e3) if r.name == LATENCY else (space[r.name].unit, 1.0)
            if r.first[0] is not None and r.second[0] is not None:
                both[r.name] = f" ({scale * r.first[0]:.4g} and {scale * r.second[0]:.4g} {unit})"
        return (
            Finding.alarm(
                "Two halves of the data disagree about "
                f"{listed([name + both.get(name, '') for name in self.flagged])}.",
                "A value that depends on the choice of data means that the model is incomplete. The "
                "intervals were widened to hold both.",
                "Find what the model lacks (see the other alarms), or fit only motion like that of the task.",
            ),
        )


FAILED = SplitHalf(note="the check failed")


def check_split_half(
    problem: Problem, refined: Refined, known: Uncertainty, allows: Allows = all_allowed
) -> SplitHalf:
    """Fit two halves of the windows alone and compare with ``refined``, the latency where that is free.

    ``refined`` has linearised residuals. Parameters that ``known`` calls unidentified are not compared.
    """
    shooting = refined.shooting
    windows = sum(len(d.windows) for d in shooting.data)
    if windows < FEWEST_WINDOWS:
        return SplitHalf(note=f"{windows} windows are too few to halve: record longer")
    cost = _steps(problem, shooting)
    if not allows(HALVES, cost):
        return SplitHalf(note=f"left out: it would take {cost:.1g} physics steps")
    before = problem.steps
    block = 1
    if known.clustered is not None:
        # Blocks as long as residuals are correlated, but at least two blocks in each half.
        longest = windows // FEWEST_WINDOWS
        block = max(1, min(round(known.clustered.block_windows), longest))
    latency_s = None if shooting.fixed_latency else refined.latency_s
    fits, halves = [], []
    for half in range(2):
        part = half_of(refined, half, block)
        # Where residuals bend too much for one step, the half is refined.
        found = one_step(part) or with_rows(refine_windows(part.shooting, part.point, HALF_ITERATIONS))
        own = uncertainty_at(problem, found, fixed_latency=latency_s is None)
        # A half holds few blocks: the clustering of all blocks holds for it, too.
        std = np.sqrt(np.diag(own.covariance)) * np.maximum(known.widened / own.widened, 1.0)
        fits.append((found.theta, found.latency_s))
        halves.append(own.widened_to(std))
    return agreement(known, fits, halves, latency_s, problem.steps - before)


def agreement(
    known: Uncertainty,
    fits: Sequence[Member],
    halves: Sequence[Uncertainty],
    latency_s: float | None,
    steps: int,
) -> SplitHalf:
    """Return whether the fits of two halves agree.

    ``known`` is the uncertainty of all data, and ``latency_s`` their latency; None where it was not searched.
    """
    space = known.space

    def three(half: int, k: int) -> tuple[float | None, float, float]:
        estimate, (low, high) = float(fits[half][0][k]), map(float, halves[half].interval[k])
        identified = halves[half].verdicts[k] != "not identifiable" and low <= estimate <= high
        return estimate if identified else None, low, high

    rows = [SplitHalfRow(name=n, first=three(0, k), second=three(1, k)) for k, n in enumerate(space.names)]
    identified = ~known.blind
    scaled = space.to_scale(np.stack([theta for theta, _ in fits]))
    expected = np.sqrt(np.sum([np.diag(h.covariance) for h in halves], axis=0))
    reach = np.append(np.max(np.abs(scaled - space.to_scale(known.theta)), axis=0), 0.0)
    if latency_s is not None:
        each = [late for _, late in fits]
        ends = [tuple(map(float, h.latency_interval_s)) for h in halves]
        first, second = ((late, low, high) for late, (low, high) in zip(each, ends, strict=True))
        rows.append(SplitHalfRow(name=LATENCY, first=first, second=second))
        identified = np.append(identified, True)
        scaled = np.column_stack([scaled, each])
        reach_s = [h.latency_reach_s(late) for late, h in zip(each, halves, strict=True)]
        expected = np.append(expected, np.linalg.norm(reach_s) / Z90)
        reach[-1] = max(abs(late - latency_s) for late in each)
    least = scipy.stats.norm.ppf(1 - SPLIT_FALSE_ALARMS / (2 * max(int(identified.sum()), 1)))
    z = np.abs(scaled[0] - scaled[1]) / np.maximum(expected, 1e-300)
    flagged = tuple(r.name for k, r in enumerate(rows) if z[k] > least and identified[k] and r.agree is False)
    compared = z[identified & [r.agree is not None for r in rows]]
    power, count = float(np.sum(compared**2)), len(compared)
    by_chance = not count or power <= scipy.stats.chi2.ppf(1 - SPLIT_FALSE_ALARMS, count)
    scale = 1.0 if by_chance else float(np.sqrt(power / count))
    return SplitHalf(tuple(rows), flagged, reach, scale, steps)


def widened_by_split_half(
    known: Uncertainty, split: SplitHalf, latency_s: float, latency_range_s: tuple[float, float]
) -> Uncertainty:
    """Return ``known`` with all intervals wider by the scale of the halves' distance.

    Those of flagged parameters, and of a flagged latency, hold the estimates of both halves. ``latency_s`` is
    the latency of all data.
    """
    if not split.flagged and split.scale == 1.0:
        return known
    flagged = np.array([name in split.flagged for name in (*known.space.names, LATENCY)])
    held = np.where(flagged, split.reach, 0.0)
    std = split.scale * np.sqrt(np.diag(known.covariance))
    wider = known.widened_to(np.maximum(std, held[:-1] / Z90))
    if reach_s := known.latency_reach_s(latency_s):
        reach_s = max(split.scale * reach_s, float(held[-1]))
        wider = wider.latency_widened_to(reach_s, latency_s, latency_range_s)
    return wider.with_alarms(last=split.alarms(known.space))


def half_of(refined: Refined, half: int, block: int) -> Refined:
    """Return a fit, which has linearised residuals, in every other block of its windows, from ``half`` on.

    The count of windows continues over recordings.
    """
    shooting, point, normal = refined.shooting, refined.point, refined.normal
    data, position, velocity, residual, back, rows, periods_s = [], [], [], [], [], [], []
    first, count = 0, 0
    for e, of_episode in enumerate(shooting.data):
        number = (first + np.arange(len(of_episode.windows))) // block
        first += len(of_episode.windows)
        mine = number % 2 == half
        if not mine.any():
            continue
        data.append(taken(of_episode, mine))
        position.append(point.position[e][mine])
        velocity.append(point.velocity[e][mine])
        residual.append(normal.residual[e][mine])
        periods_s.append(normal.periods_s[e])
        gain, shift = normal.back[e]
        back.append((gain[mine], shift[mine]))
        whole = normal.rows[e]
        rows.append(WindowRows(whole.residual[mine], whole.parameter[mine], whole.start[mine]))
        count += int(np.count_nonzero(data[-1].reported) if shooting.given else np.sum(data[-1].freedom))
    part = shooting.on(data)
    there = Point(point.value, tuple(position), tuple(velocity))
    cost = float(normal.prior @ (point.value - shooting.prior_mean) ** 2)
    cost += sum(float(np.sum(r.residual**2)) for r in rows)
    left = dataclasses.replace(normal, residual=tuple(residual), back=tuple(back), periods_s=tuple(periods_s))
    kept = dataclasses.replace(left, cost=cost, count=count)
    return refined_at(part, there, of_rows(part, there, kept, tuple(rows)))


def _steps(problem: Problem, shooting: Shooting) -> float:
    """Return the most physics steps that the comparison takes."""
    periods = shooting.seconds / problem.robot.step_s
    # One normal matrix and one line of damped steps per iteration.
    members = 2 + len(problem.space) + 2 * problem.coordinates + 10
    return float(HALF_ITERATIONS * members * periods)
