"""Effects of discrete time on a fit: whole device ticks and whole physics steps.

Latency: the device acts on period boundaries, so the fit is repeated at whole ticks.

Physics step: the error of a first-order integrator (MuJoCo's Euler, implicit and implicitfast) is
proportional to its step, and a fit turns it into damping, armature or delay. Half the step removes half the
error. So the shift of the fit under half the step is half the shift that the step has caused. The recordings
must also agree with the finer step: data that were simulated with the model's own step do not.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import Uncertainty
from deal_hw.calib.fit.refinement import Refined, refine_windows
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.hypotheses.thresholds import NOTICED
from deal_hw.calibration import Z90, Progress, ProgressCallback, listed
from deal_hw.findings import Finding
from deal_hw.sim.engine.model import at_step
from deal_hw.types import FloatArray

SCAN_TICKS = 2
"""Ticks on either side of the estimate that are fitted first."""

SCAN_ITERATIONS = 10
"""Most iterations of each fit."""

CONTACT_TICKS = 1
"""The same with feet on the floor, where a fit costs ten times as much."""

CONTACT_ITERATIONS = 2
"""The same for iterations; these fits begin at fitted states."""

HOPELESS = 100.0
"""Predicted cost above the least at which a tick is not fitted [noise variances]: ten standard deviations,
the largest known shift by a kink."""

WORSE = 9.0
"""Cost above that of the free latency at which whole ticks have not converged; then the free latency is
kept."""

MOST_TICKS = 15
"""Most ticks."""


@dataclass(frozen=True, slots=True)
class LatencyScan:
    """Refinements at whole device ticks of latency.

    Attributes:
        ticks: Latencies [device ticks], (L,).
        refined: The refinement at each.
    """

    ticks: tuple[int, ...]
    refined: tuple[Refined, ...]

    @property
    def best(self) -> int:
        """Index of the latency with the least chi-square."""
        return int(np.argmin([p.normal.cost for p in self.refined]))

    @property
    def weights(self) -> FloatArray:
        """Probability of each latency, (L,); sums to 1."""
        cost = np.array([p.normal.cost for p in self.refined])
        scale = max(1.0, self.refined[self.best].chi2)
        weight = np.exp(-0.5 * (cost - cost.min()) / scale)
        return np.asarray(weight / weight.sum())

    def decides(self, free: Refined) -> bool:
        """Return whether a whole tick explains the recordings about as well as a free latency."""
        return self.refined[self.best].normal.cost < free.normal.cost + WORSE


def scan_latency(problem: Problem, refined: Refined, progress: ProgressCallback | None) -> LatencyScan | None:
    """Refine again at the whole device ticks around the estimated latency.

    The device acts on period boundaries, so its latency is a whole number of ticks. Knowing that sharpens the
    other parameters; the ticks that remain plausible show by how much. Where the recordings put the latency
    between two ticks, as with commands that come at any time, no tick is worth a fit, and there is no scan.
    """
    tick = problem.step_s
    centre = round(refined.latency_s / tick)
    low, high = (round(v / tick) for v in problem.latency_range_s)
    contacts = problem.robot.base is not None
    reach, iterations = SCAN_TICKS, SCAN_ITERATIONS
    if contacts:
        reach, iterations = CONTACT_TICKS, CONTACT_ITERATIONS
    if not contacts:
        # In a smooth problem the curvature shows up to which distance a tick is worth a fit.
        variance = np.linalg.inv(_information(refined))[-1, -1]
        worth_s = np.sqrt(HOPELESS * max(1.0, refined.chi2) * variance)
        low = max(low, math.ceil((refined.latency_s - worth_s) / tick))
        high = min(high, math.floor((refined.latency_s + worth_s) / tick))
    found: dict[int, Refined] = {}
    if problem.noise_free:
        # The given refinement is at a whole tick, with more iterations than its neighbours get.
        found[centre] = refined
    waiting = [t for t in range(centre - reach, centre + reach + 1) if low <= t <= high and t not in found]
    if not waiting and not found:
        return None
    shooting = refined.shooting.on(refined.shooting.data, fixed_latency=True)
    while waiting and len(found) < MOST_TICKS:
        t = waiting.pop(0)
        start = shooting.followed(refined.point, refined.normal, _latency_step(refined, t * tick))
        found[t] = refine_windows(shooting, start, iterations)
        if progress is not None:
            progress(
                Progress(
                    "latency", len(found), len(found) + len(waiting), f"{t} ticks: chi2 {found[t].chi2:.3g}"
                )
            )
        best = min(found, key=lambda tick: found[tick].normal.cost)
        if not waiting:
            # A minimum must have neighbours on both sides.
            waiting = [t for t in (best - 1, best + 1) if low <= t <= high and t not in found]
    ticks = tuple(sorted(found))
    return LatencyScan(ticks, tuple(found[t] for t in ticks))


def _information(refined: Refined) -> FloatArray:
    """Return the information on parameters and latency, (K + 1, K + 1); the range tells what data do not."""
    prior = np.append(1.0 / refined.shooting.problem.space.width**2, 0.0)
    return np.asarray(refined.normal.hessian + np.diag(prior))


def _latency_step(refined: Refined, latency_s: float) -> FloatArray:
    """Return the step to where a fit ends at another latency, were its predictions straight, (K + 1,)."""
    information, shift = _information(refined), latency_s - refined.latency_s
    others = -np.linalg.solve(information[:-1, :-1], information[:-1, -1]) * shift
    return np.append(others, shift)


def averaged(problem: Problem, scan: LatencyScan, best: Uncertainty) -> Uncertainty:
    """Widen the uncertainty at the best latency by the spread over the plausible latencies."""
    space, tick = best.space, problem.step_s
    center = space.to_scale(best.theta)
    covariance = np.zeros_like(best.covariance)
    for weight, refined in zip(scan.weights, scan.refined, strict=True):
        shift = space.to_scale(refined.theta) - center
        covariance += weight * (best.covariance + np.outer(shift, shift))
    ticks = np.array(scan.ticks)
    spread = float(np.sqrt(np.sum(scan.weights * (ticks - ticks[scan.best]) ** 2)))
    # A tick is decided or not: rounding leaves at least half a tick open.
    half = max(Z90 * spread, 0.5) * tick
    latency = scan.refined[scan.best].latency_s
    low, high = problem.latency_range_s
    interval_s = max(latency - half, low), min(latency + half, high)
    return dataclasses.replace(best.with_covariance(covariance), latency_interval_s=interval_s)


CLEARLY = 4.0
"""Chi-square difference that decides between two steps [-]. If the finer step is in truth d standard
deviations worse, the difference is -d^2 with a spread of 2 d. So by chance it is above 4 in at most 2.3 %
of recordings, for any d."""

MOST_STEPS = 3e8
"""Most physics steps of the comparison."""

HALVINGS = 2
"""Most times that the step is halved to explain a residual. A fourth of it costs four local fits, less
than a search."""


@dataclass(frozen=True, slots=True)
class StepCheck:
    """Result of a comparison with half the physics step.

    Attributes:
        step_s: The model's physics step [s].
        bias: Shift by the step of each parameter, in its own scale, and of the latency [s], (K + 1,).
        gain: Decrease of chi-square with half the step; negative for an increase.
        share: The same as a share of chi-square [-].
        note: Why nothing was compared.
    """

    step_s: float
    bias: FloatArray = field(default_factory=lambda: np.zeros(0))
    gain: float = 0.0
    share: float = 0.0
    note: str = ""

    @property
    def coarse(self) -> bool:
        """Whether half the step explains the recordings better, by more than chance."""
        return not self.note and self.gain > CLEARLY and self.share > NOTICED

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        if self.note:
            return {"step_s": self.step_s, "note": self.note}
        return {
            "step_s": self.step_s,
            "bias": self.bias.tolist(),
            "chi2_gain": self.gain,
            "share": self.share,
        }


def check_step(problem: Problem, refined: Refined, most_steps: float = MOST_STEPS) -> StepCheck:
    """Compare predictions with the model's step and with half of it; the fit has linearised residuals."""
    step_s = problem.robot.step_s
    if problem.robot.base is not None:
        # A contact at another moment changes a prediction more than the step's error does.
        return StepCheck(step_s, note="not compared for robots in contact")
    shooting, rows = refined.shooting, refined.normal.rows
    steps = 3.0 * shooting.seconds / step_s
    if steps > most_steps:
        return StepCheck(step_s, note=f"not compared: it would take {steps:.1g} physics steps")
    finer = Shooting(halved(problem), shooting.length, data=shooting.data)
    before, after = shooting.residuals(refined.point), finer.residuals(refined.point)
    if not all(np.isfinite(r).all() for r in after):
        return StepCheck(step_s, note="not compared: half the step diverged")
    moved = [_shifted(r, b - a) for r, a, b in zip(rows, before, after, strict=True)]
    width = np.append(problem.space.width, np.ptp(problem.latency_range_s))
    belief = refined.normal.prior + 12.0 / width**2
    if problem.fixed_latency_s is not None:
        # A given latency takes no part of the step's error.
        belief[-1] = np.inf
    cost, where = _refitted(rows, belief)
    finer_cost, finer_where = _refitted(moved, belief)
    # First order: half the step removes half of what the whole step is off.
    return StepCheck(step_s, 2.0 * (finer_where - where), cost - finer_cost, 1.0 - finer_cost / cost)


def counted(problem: Problem, known: Uncertainty, found: StepCheck) -> Uncertainty:
    """Return ``known`` with intervals widened by the step's shift, unless the recordings contradict it."""
    if found.note or found.gain < -CLEARLY:
        return known
    std = np.sqrt(np.diag(known.covariance)) + np.abs(found.bias[:-1]) / Z90
    known = known.widened_to(std)
    (first, last), (low, high) = problem.latency_range_s, known.latency_interval_s
    if low == high:
        return known
    more = abs(float(found.bias[-1]))
    return dataclasses.replace(known, latency_interval_s=(max(low - more, first), min(high + more, last)))


def step_alarm(known: Uncertainty, found: StepCheck) -> tuple[Finding, ...]:
    """Return the alarm of a step that is too coarse, if it is; ``known`` is without the step's shift."""
    if not found.coarse:
        return ()
    half_width = Z90 * np.sqrt(np.diag(known.covariance))
    moved = np.abs(found.bias[:-1]) > half_width
    names = [n for n, m, b in zip(known.space.names, moved, known.blind, strict=True) if m and not b]
    if not names:
        return ()
    return (
        Finding.alarm(
            f"With half the physics step ({500 * found.step_s:g} ms) the recordings are explained better "
            f"(chi-square {found.gain:.3g} lower), and these would leave their intervals: {listed(names)}.",
            f"A step of {1e3 * found.step_s:g} ms is too coarse: its error went into these values.",
            f"Calibrate with --physics-step {found.step_s / 2:g} or less, and train with that step.",
        ),
    )


def halved(problem: Problem) -> Problem:
    """Return the problem with half the physics step; recordings, noise and smoothed states are shared."""
    return problem.sharing(robot=at_step(problem.robot, problem.robot.step_s / 2.0))


def _shifted(rows: WindowRows, change: FloatArray) -> WindowRows:
    """Return the rows with changed predictions, (W, H, M) whitened; priors of start states stay."""
    residual = rows.residual.copy()
    residual[:, : change[0].size] += change.reshape(len(change), -1)
    return dataclasses.replace(rows, residual=residual)


def _refitted(
    rows: tuple[WindowRows, ...] | list[WindowRows], belief: FloatArray
) -> tuple[float, FloatArray]:
    """Return the cost after a linear refit, and its step, (K + 1,); ``belief`` is the prior information."""
    P = len(belief)
    cost, gradient, hessian = 0.0, np.zeros(P), np.diag(belief)
    for one in rows:
        jacobian, residual = one.following, one.rest
        cost += float(np.sum(residual**2))
        gradient += np.einsum("wri,wr->i", jacobian, residual)
        hessian += np.einsum("wri,wrj->ij", jacobian, jacobian)
    free = np.isfinite(belief)
    step = np.zeros(P)
    step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
    return cost + float(gradient @ step), np.asarray(step, dtype=np.float64)
