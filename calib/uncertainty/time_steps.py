"""What discrete time does to a fit: the device acts on whole ticks, the simulator takes whole physics steps.

Latency: the device acts on period boundaries, so the fit is repeated at whole ticks.

Physics step: an integrator of first order (MuJoCo's Euler, implicit and implicitfast) errs in proportion to
its step, and a fit turns that error into damping, armature or delay. Half the step removes half of it, so
where the fit would go with half the step says how far the step has moved it: twice as far. Whether the
recordings agree with the finer step is asked too: data that were simulated with the model's own step do not.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined, refine_windows
from deal_hw.calib.fit.residual import Point, Shooting, WindowRows
from deal_hw.calib.uncertainty.cluster_robust import eliminated, without_starts
from deal_hw.calib.uncertainty.intervals import Uncertainty, intervals, widened_to
from deal_hw.calibration import Z90, Alarm, Progress, ProgressCallback, listed
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanSettings:
    """Settings of :func:`scan_latency`.

    Attributes:
        ticks: Ticks to either side of the latency found that are fitted at first.
        iterations: Most iterations of each fit.
        contact_ticks: The same where feet touch the floor: a tick's fit costs ten times as much there,
        contact_iterations: but starts from fitted states.
        hopeless: A tick whose cost would be so many times the noise's above the least is not fitted: ten
            standard deviations, as far as a kink is known to shift the least.
        worse: Whole ticks that all cost this much more than the free latency did not converge: the free one
            is kept.
        most: Most ticks.
    """

    ticks: int = 2
    iterations: int = 10
    contact_ticks: int = 1
    contact_iterations: int = 2
    hopeless: float = 100.0
    worse: float = 9.0
    most: int = 15


SCAN = ScanSettings()


@dataclass(frozen=True, slots=True)
class LatencyScan:
    """What the refinement finds at whole device ticks of latency.

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
        """How plausible each latency is, (L,); sums to 1."""
        cost = np.array([p.normal.cost for p in self.refined])
        scale = max(1.0, self.refined[self.best].chi2)
        weight = np.exp(-0.5 * (cost - cost.min()) / scale)
        return np.asarray(weight / weight.sum())

    def decides(self, free: Refined) -> bool:
        """Return whether a whole tick explains the recordings about as well as a free latency."""
        return self.refined[self.best].normal.cost < free.normal.cost + SCAN.worse


def scan_latency(problem: Problem, refined: Refined, progress: ProgressCallback | None) -> LatencyScan:
    """Refine again at the whole device ticks around the latency found.

    The device acts on period boundaries, so its latency is a whole number of ticks; knowing that sharpens the
    other parameters, and the ticks that remain plausible say how much.
    """
    tick = problem.episodes[0].step_s
    centre = round(refined.latency_s / tick)
    low, high = (round(v / tick) for v in problem.latency_range_s)
    contacts = problem.robot.base is not None
    reach, iterations = SCAN.ticks, SCAN.iterations
    if contacts:
        reach, iterations = SCAN.contact_ticks, SCAN.contact_iterations
    if not contacts:
        # In a smooth problem the curvature says how far off a tick is worth a fit.
        worth_s = np.sqrt(SCAN.hopeless * max(1.0, refined.chi2) * _latency_variance(refined))
        low = max(low, min(math.ceil((refined.latency_s - worth_s) / tick), centre))
        high = min(high, max(math.floor((refined.latency_s + worth_s) / tick), centre))
    found: dict[int, Refined] = {}
    if problem.noise_free:
        # That refinement was at a whole tick, with more iterations than are spent on its neighbours.
        found[centre] = refined
    waiting = [t for t in range(centre - reach, centre + reach + 1) if low <= t <= high and t not in found]
    while waiting and len(found) < SCAN.most:
        t = waiting.pop(0)
        start = _at_latency(refined, t * tick)
        found[t] = refine_windows(refined.shooting, start, iterations, fixed_latency=True)
        if progress is not None:
            progress(
                Progress(
                    "latency", len(found), len(found) + len(waiting), f"{t} ticks: chi2 {found[t].chi2:.3g}"
                )
            )
        best = min(found, key=lambda tick: found[tick].normal.cost)
        if not waiting:
            # The least must lie inside what was scanned, or it is not known to be one.
            waiting = [t for t in (best - 1, best + 1) if low <= t <= high and t not in found]
    ticks = tuple(sorted(found))
    return LatencyScan(ticks, tuple(found[t] for t in ticks))


def _information(refined: Refined) -> FloatArray:
    """Return the information on parameters and latency, (K + 1, K + 1); the range tells what data do not."""
    prior = np.append(1.0 / refined.shooting.problem.space.width**2, 0.0)
    return np.asarray(refined.normal.hessian + np.diag(prior))


def _latency_variance(refined: Refined) -> float:
    """Return the latency's variance under the sensors' noise, all parameters free [s^2]."""
    return float(np.linalg.inv(_information(refined))[-1, -1])


def _at_latency(refined: Refined, latency_s: float) -> Point:
    """Return where a fit ends at another latency, were its predictions straight in everything."""
    information, shift = _information(refined), latency_s - refined.latency_s
    others = -np.linalg.solve(information[:-1, :-1], information[:-1, -1]) * shift
    return refined.shooting.followed(refined.point, refined.normal, np.append(others, shift))


def averaged(problem: Problem, scan: LatencyScan, best: Uncertainty) -> Uncertainty:
    """Widen the best latency's statement by what the other plausible latencies would say."""
    space, tick = problem.space, problem.episodes[0].step_s
    center = space.to_scale(scan.refined[scan.best].theta)
    covariance = np.zeros_like(best.covariance)
    for weight, refined in zip(scan.weights, scan.refined, strict=True):
        shift = space.to_scale(refined.theta) - center
        covariance += weight * (best.covariance + np.outer(shift, shift))
    ticks = np.array(scan.ticks)
    spread = float(np.sqrt(np.sum(scan.weights * (ticks - ticks[scan.best]) ** 2)))
    # A tick is decided or not: half a tick is the least that rounding leaves open.
    half = max(Z90 * spread, 0.5) * tick
    latency = scan.refined[scan.best].latency_s
    low, high = problem.latency_range_s
    return dataclasses.replace(
        best,
        covariance=covariance,
        interval=intervals(space, scan.refined[scan.best].theta, covariance, best.shape),
        latency_interval_s=(max(latency - half, low), min(latency + half, high)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class StepSettings:
    """Settings of :func:`check_step`.

    Attributes:
        clearly: Chi-square by which one step must explain the recordings better than the other [-]. Where the
            finer step is in truth d standard deviations worse the difference is -d^2 with a spread of 2 d,
            so by chance it is above 4 in at most 2.3 % of recordings, whatever d is.
        most_steps: More physics steps than this are not spent on the comparison.
    """

    clearly: float = 4.0
    most_steps: float = 3e8


STEP = StepSettings()


@dataclass(frozen=True, slots=True)
class StepCheck:
    """What half the physics step says.

    Attributes:
        step_s: The model's physics step [s].
        bias: By how much the step moves each parameter, in its own scale, and the latency [s], (K + 1,).
        gain: By how much less chi-square half the step leaves; negative where it leaves more.
        note: Why nothing was compared.
    """

    step_s: float
    bias: FloatArray
    gain: float = 0.0
    note: str = ""

    @property
    def rejected(self) -> bool:
        """Whether the recordings speak against the finer step, as simulated ones do."""
        return self.gain < -STEP.clearly

    @property
    def preferred(self) -> bool:
        """Whether the recordings ask for the finer step."""
        return self.gain > STEP.clearly

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        if self.note:
            return {"step_s": self.step_s, "note": self.note}
        return {"step_s": self.step_s, "bias": self.bias.tolist(), "chi2_gain": self.gain}


def check_step(problem: Problem, refined: Refined, settings: StepSettings | None = None) -> StepCheck:
    """Compare predictions with the model's step and with half of it.

    Args:
        problem: Recordings and simulator.
        refined: Where the fit ended, with linearised residuals.
        settings: What it may cost.
    """
    step_s, K = problem.robot.step_s, len(problem.space)
    nothing = np.zeros(K + 1)
    if problem.robot.base is not None:
        # Feet that touch at another moment change a prediction more than the step's error does.
        return StepCheck(step_s, nothing, note="not compared for robots in contact")
    shooting, rows = refined.shooting, refined.normal.rows
    samples = sum(len(d.windows) * d.windows.length * d.windows.stride for d in shooting.data)
    steps = 3.0 * samples * problem.episodes[0].step_s / step_s
    if steps > (settings or STEP).most_steps:
        return StepCheck(step_s, nothing, note=f"not compared: it would take {steps:.1g} physics steps")
    finer = Shooting(halved(problem), shooting.length, data=shooting.data)
    before, after = shooting.residuals(refined.point), finer.residuals(refined.point)
    if not all(np.isfinite(r).all() for r in after):
        return StepCheck(step_s, nothing, note="not compared: half the step diverged")
    moved = [_shifted(r, b - a) for r, a, b in zip(rows, before, after, strict=True)]
    width = np.append(problem.space.width, np.ptp(problem.latency_range_s))
    belief = refined.normal.prior + 12.0 / width**2
    if problem.fixed_latency_s is not None:
        # A latency that is given takes nothing of the step's error.
        belief[-1] = np.inf
    cost, where = _refitted(rows, belief)
    finer_cost, finer_where = _refitted(moved, belief)
    # First order: half the step removes half of what the whole step is off.
    return StepCheck(step_s, 2.0 * (finer_where - where), cost - finer_cost)


def counted(problem: Problem, known: Uncertainty, theta: FloatArray, found: StepCheck) -> Uncertainty:
    """Return what is known, intervals as much wider as the step moves their parameters.

    Args:
        problem: Says the range of the latency.
        known: What was known before.
        theta: The estimate, (K,).
        found: What half the step says; nothing changes where the recordings speak against it.
    """
    if found.note or found.rejected:
        return known
    std = np.sqrt(np.diag(known.covariance)) + np.abs(found.bias[:-1]) / Z90
    known = widened_to(problem, known, theta, std)
    (first, last), (low, high) = problem.latency_range_s, known.latency_interval_s
    if low == high:
        return known
    more = abs(float(found.bias[-1]))
    return dataclasses.replace(known, latency_interval_s=(max(low - more, first), min(high + more, last)))


def step_alarm(problem: Problem, known: Uncertainty, found: StepCheck) -> tuple[Alarm, ...]:
    """Return the alarm of a step that is too coarse; none where it is fine.

    Args:
        problem: Says the parameters' names.
        known: What was known before the step was counted.
        found: What half the step says.
    """
    if found.note or not found.preferred:
        return ()
    half_width = Z90 * np.sqrt(np.diag(known.covariance))
    moved = np.abs(found.bias[:-1]) > half_width
    names = [n for n, m, b in zip(problem.space.names, moved, known.shape.blind, strict=True) if m and not b]
    if not names:
        return ()
    return (
        Alarm(
            f"With half the physics step ({500 * found.step_s:g} ms) the recordings are explained better "
            "(chi-square "
            f"{found.gain:.3g} lower), and these would leave their intervals: {listed(names)}.",
            f"A step of {1e3 * found.step_s:g} ms is too coarse: its error went into these values.",
            f"Calibrate with --physics-step {found.step_s / 2:g} or less, and train with that step.",
        ),
    )


def halved(problem: Problem) -> Problem:
    """Return the problem with half the physics step; recordings, noise and smoothed states are shared."""
    model = copy.copy(problem.robot.model)
    model.opt.timestep /= 2.0
    return problem.with_robot(dataclasses.replace(problem.robot, model=model))


def _shifted(rows: WindowRows, change: FloatArray) -> WindowRows:
    """Return the rows with predictions changed, (W, H, M) whitened; what is known of start states stays."""
    residual = rows.residual.copy()
    residual[:, : change[0].size] += change.reshape(len(change), -1)
    return dataclasses.replace(rows, residual=residual)


def _refitted(
    rows: tuple[WindowRows, ...] | list[WindowRows], belief: FloatArray
) -> tuple[float, FloatArray]:
    """Return the cost that a linear refit leaves, and the step to it, (K + 1,).

    Args:
        rows: Linearised residuals.
        belief: What is known of parameters and latency without the data, (K + 1,).
    """
    P = len(belief)
    cost, gradient, hessian = 0.0, np.zeros(P), np.diag(belief)
    for one in rows:
        jacobian, normal = eliminated(one)
        residual = without_starts(one.start, normal, one.residual[..., None])[..., 0]
        cost += float(np.sum(residual**2))
        gradient += np.einsum("wri,wr->i", jacobian, residual)
        hessian += np.einsum("wri,wrj->ij", jacobian, jacobian)
    free = np.isfinite(belief)
    step = np.zeros(P)
    step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
    return cost + float(gradient @ step), np.asarray(step, dtype=np.float64)
