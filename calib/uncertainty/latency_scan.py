"""What the fit finds at whole device ticks of latency: the device acts on period boundaries."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished, polish
from deal_hw.calib.uncertainty.intervals import Z90, Uncertainty, intervals
from deal_hw.calibration import Progress, ProgressCallback
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


SETTINGS = ScanSettings()


@dataclass(frozen=True, slots=True)
class LatencyScan:
    """What the polish finds at whole device ticks of latency.

    Attributes:
        ticks: Latencies [device ticks], (L,).
        polished: The polish at each.
    """

    ticks: tuple[int, ...]
    polished: tuple[Polished, ...]

    @property
    def best(self) -> int:
        """Index of the latency with the least chi-square."""
        return int(np.argmin([p.normal.cost for p in self.polished]))

    @property
    def weights(self) -> FloatArray:
        """How plausible each latency is, (L,); sums to 1."""
        cost = np.array([p.normal.cost for p in self.polished])
        scale = max(1.0, self.polished[self.best].chi2)
        weight = np.exp(-0.5 * (cost - cost.min()) / scale)
        return np.asarray(weight / weight.sum())

    def decides(self, free: Polished) -> bool:
        """Return whether a whole tick explains the recordings about as well as a free latency."""
        return self.polished[self.best].normal.cost < free.normal.cost + SETTINGS.worse


def scan_latency(problem: Problem, polished: Polished, progress: ProgressCallback | None) -> LatencyScan:
    """Polish again at the whole device ticks around the latency found.

    The device acts on period boundaries, so its latency is a whole number of ticks; knowing that sharpens the
    other parameters, and the ticks that remain plausible say how much.
    """
    tick = problem.episodes[0].step_s
    centre = round(polished.latency_s / tick)
    low, high = (round(v / tick) for v in problem.latency_range_s)
    length_s = polished.shooting.length * problem.episodes[0].period_s
    states = polished.shooting.states(polished.point)
    contacts = problem.robot.base is not None
    reach, iterations = SETTINGS.ticks, SETTINGS.iterations
    if contacts:
        reach, iterations = SETTINGS.contact_ticks, SETTINGS.contact_iterations
    if not contacts:
        # In a smooth problem the curvature says how far off a tick is worth a fit.
        worth_s = np.sqrt(SETTINGS.hopeless * max(1.0, polished.chi2) * _latency_variance(polished))
        low = max(low, min(math.ceil((polished.latency_s - worth_s) / tick), centre))
        high = min(high, max(math.floor((polished.latency_s + worth_s) / tick), centre))
    found: dict[int, Polished] = {}
    if problem.exact:
        # That polish was at a whole tick, with more iterations than are spent on its neighbours.
        found[centre] = polished
    waiting = [t for t in range(centre - reach, centre + reach + 1) if low <= t <= high and t not in found]
    while waiting and len(found) < SETTINGS.most:
        t = waiting.pop(0)
        found[t] = polish(
            problem,
            polished.theta,
            t * tick,
            (length_s,),
            iterations=iterations,
            fixed_latency=True,
            shake=False,
            states=states,
        )
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


def _latency_variance(polished: Polished) -> float:
    """Return the latency's variance under the sensors' noise, all parameters free [s^2]."""
    prior = np.append(1.0 / polished.shooting.problem.space.width**2, 0.0)
    return float(np.linalg.inv(polished.normal.hessian + np.diag(prior))[-1, -1])


def averaged(problem: Problem, scan: LatencyScan, best: Uncertainty) -> Uncertainty:
    """Widen the best latency's statement by what the other plausible latencies would say."""
    space, tick = problem.space, problem.episodes[0].step_s
    center = space.to_scale(scan.polished[scan.best].theta)
    covariance = np.zeros_like(best.covariance)
    for weight, polished in zip(scan.weights, scan.polished, strict=True):
        shift = space.to_scale(polished.theta) - center
        covariance += weight * (best.covariance + np.outer(shift, shift))
    ticks = np.array(scan.ticks)
    spread = float(np.sqrt(np.sum(scan.weights * (ticks - ticks[scan.best]) ** 2)))
    # A tick is decided or not: half a tick is the least that rounding leaves open.
    half = max(Z90 * spread, 0.5) * tick
    latency = scan.polished[scan.best].latency_s
    low, high = problem.latency_range_s
    return dataclasses.replace(
        best,
        covariance=covariance,
        interval=intervals(space, scan.polished[scan.best].theta, covariance, best.shape),
        latency_interval_s=(max(latency - half, low), min(latency + half, high)),
    )
