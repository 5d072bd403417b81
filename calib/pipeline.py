"""The whole calibration: check, search, polish, latency scan, restart until explained, intervals, held-out error."""

from __future__ import annotations

import dataclasses
import time

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.excitation import check_excitation
from deal_hw.calib.identifiability import MISMATCH_CHI2, uncertainty
from deal_hw.calib.problem import Problem
from deal_hw.calib.refine import Polished, polish
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, Progress, ProgressCallback

RESTARTS = 3
SAME_CHI2 = 0.02
SCAN_TICKS = 2


@dataclass(frozen=True, slots=True)
class LatencyScan:
    """Chi-square by latency, in device ticks.

    Attributes:
        ticks: Latencies [device ticks], (L,).
        chi2: (L,).
    """

    ticks: tuple[int, ...]
    chi2: tuple[float, ...]

    @property
    def best(self) -> int:
        """The latency whose chi-square is least [device ticks]."""
        return self.ticks[int(np.argmin(self.chi2))]


class PolishedMethod(CalibrationMethod[Problem]):
    """A search followed by the polish; the search is run again from other draws while the residual is unexplained.

    Args:
        search: The search.
        name: Name of the whole.
    """

    def __init__(self, search: CalibrationMethod[Problem], name: str | None = None) -> None:
        self.search = search
        self.name = name or search.name

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Search, polish, scan the latency, state what is known. See :class:`CalibrationMethod`."""
        began, steps = time.perf_counter(), problem.steps
        check_excitation(problem)
        searched, polished, restarts = self._until_explained(problem, budget, rng, progress)
        fixed = problem.fixed_latency_s is not None
        scan = None if fixed else scan_latency(problem, polished, progress)
        known = uncertainty(
            problem.space, polished.theta, polished.latency_s, polished.normal.hessian, polished.chi2,
            polished.normal.residual, problem.latency_range_s, fixed,
        )  # fmt: skip
        provenance = dict(searched.provenance) | {
            "search": searched.method,
            "restarts": restarts,
            "window_s": polished.shooting.length * _period(problem),
            "noise_std": problem.noise_std.tolist(),
            "inflation": known.inflation,
            "polish_iterations": polished.iterations,
            "search_estimate": dict(zip(problem.space.names, map(float, searched.estimate), strict=True)),
        }
        if scan is not None:
            provenance["latency_scan"] = {
                "ticks": list(scan.ticks),
                "chi2": list(scan.chi2),
                "best": scan.best,
            }
        return dataclasses.replace(
            searched,
            method=self.name,
            estimate=polished.theta,
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=known.null_directions,
            latency_s=polished.latency_s,
            latency_interval_s=known.latency_interval_s,
            chi2=polished.chi2,
            alarms=known.alarms,
            steps=problem.steps - steps,
            seconds=time.perf_counter() - began,
            provenance=provenance,
        )

    def _until_explained(
        self, problem: Problem, budget: Budget, rng: np.random.Generator, progress: ProgressCallback | None
    ) -> tuple[CalibrationResult, Polished, int]:
        best: tuple[CalibrationResult, Polished] | None = None
        for attempt in range(1 + RESTARTS):
            searched = self.search.run(problem, budget, rng, progress)
            polished = polish_from(problem, searched, progress)
            previous = best[1].chi2 if best is not None else np.inf
            if best is None or _better(polished, best[1]):
                best = (searched, polished)
            # Two searches that end at the same unexplained residual say that the model is wrong, not the search.
            same = abs(polished.chi2 - previous) < SAME_CHI2 * previous
            if best[1].chi2 < MISMATCH_CHI2 or same:
                break
        if best is None:
            raise RuntimeError("unreachable: at least one search is run")
        return (*best, attempt)


def _better(a: Polished, b: Polished) -> bool:
    """Say whether ``a`` explains more: a longer window only counts where both are explained."""
    if a.chi2 < MISMATCH_CHI2 and b.chi2 < MISMATCH_CHI2 and a.shooting.length != b.shooting.length:
        return a.shooting.length > b.shooting.length
    return a.chi2 < b.chi2


def _period(problem: Problem) -> float:
    episode = problem.episodes[0]
    return float(np.median(np.diff(episode.sample))) * episode.step_s


def polish_from(problem: Problem, searched: CalibrationResult, progress: ProgressCallback | None) -> Polished:
    """Polish a search's estimate and, where that is not explained, the best members of its last population."""
    fixed = problem.fixed_latency_s is not None
    latency = searched.latency_s if problem.fixed_latency_s is None else problem.fixed_latency_s

    def notify(done: int, chi2: float) -> None:
        if progress is not None:
            progress(Progress("polish", done, done, f"chi2 {chi2:.3g}"))

    return polish(problem, searched.estimate, latency, fixed_latency=fixed, notify=notify)


def scan_latency(problem: Problem, polished: Polished, progress: ProgressCallback | None) -> LatencyScan:
    """Polish again at the whole device ticks around the latency found, and note each one's chi-square."""
    tick = problem.episodes[0].step_s
    centre = round(polished.latency_s / tick)
    low, high = (round(v / tick) for v in problem.latency_range_s)
    ticks = [t for t in range(centre - SCAN_TICKS, centre + SCAN_TICKS + 1) if low <= t <= high]
    length_s = polished.shooting.length * _period(problem)
    chi2 = []
    for i, t in enumerate(ticks):
        at = polish(problem, polished.theta, t * tick, (length_s / 2,), iterations=3, fixed_latency=True)
        chi2.append(at.chi2)
        if progress is not None:
            progress(Progress("latency", i + 1, len(ticks), f"{t} ticks: chi2 {at.chi2:.3g}"))
    return LatencyScan(tuple(ticks), tuple(chi2))
