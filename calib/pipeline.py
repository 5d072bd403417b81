"""The whole calibration: check, search, polish, latency scan, restarts until explained, intervals."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import CONTACT_STAGES_S, STAGES_S, Polished, polish
from deal_hw.calib.fit.robust import HEAVY_TAILS, kurtosis, robust_polish
from deal_hw.calib.search.restarts import Attempts
from deal_hw.calib.uncertainty.at_fit import statement, with_rows
from deal_hw.calib.uncertainty.intervals import MISMATCH_CHI2, Z90, Uncertainty, intervals
from deal_hw.calib.validation.checks import Validation, judge, unexplained
from deal_hw.calib.validation.cross_validation import Choice, at_estimate, choose
from deal_hw.calibration import (
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray

RESTARTS = 2
SAME_CHI2 = 0.2
FEWEST_GENERATIONS = 15
"""With fewer generations left in the budget another search would not get anywhere."""

LOCAL_S = 8.0
"""The local fit finds its way on so much of the recordings [s]."""

LOCAL_HOPELESS = 4.0
"""Windows of 0.2 s whose chi2 stays above this are not explained by longer fits either."""

SCAN_TICKS = 2
SCAN_ITERATIONS = 10
CONTACT_ITERATIONS = 2
"""Where feet touch the floor a tick's polish starts from fitted states and costs ten times as much."""

SCAN_HOPELESS = 100.0
"""A tick whose cost would be so many times the noise's above the least is not fitted: ten standard
deviations, as far as a kink is known to shift the least."""

SCAN_WORSE = 9.0
"""Whole ticks that all cost this much more than the free latency did not converge: the free one is kept."""

SCAN_MOST = 15


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


class PolishedMethod(CalibrationMethod[Problem]):
    """A search followed by the polish; searched again from other draws while the residual is unexplained.

    Args:
        search: The search.
        name: Name of the whole.
        settings: What is checked afterwards.
    """

    def __init__(
        self,
        search: CalibrationMethod[Problem],
        name: str | None = None,
        settings: Validation | None = None,
    ) -> None:
        self.search = search
        self.settings = settings or Validation()
        self.name = name or search.name

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Search, polish, scan the latency, state what is known. See :meth:`CalibrationMethod.run`.

        A resumed run takes finished searches from the checkpoint and polishes again, which draws nothing.
        """
        began, steps = time.perf_counter(), problem.steps
        check_excitation(problem)
        local = local_fit(problem, progress) if self.settings.local_first else None
        earlier_steps, earlier_seconds = 0, 0.0
        if local is not None and conclusive(problem, local):
            result = self.concluded(problem, without_search(problem, budget, local), local, progress=progress)
        else:
            attempts = Attempts(self.search, problem, rng, checkpoint)
            searched, polished, restarts = _until_explained(attempts, problem, budget, progress)
            choice = self._choose(problem, budget, rng, searched, polished, progress)
            result = self.concluded(problem, searched, polished, choice, restarts, progress)
            earlier_steps, earlier_seconds = attempts.earlier_steps, attempts.earlier_seconds
        return dataclasses.replace(
            result,
            steps=problem.steps - steps + earlier_steps,
            seconds=time.perf_counter() - began + earlier_seconds,
        )

    def concluded(
        self,
        problem: Problem,
        searched: CalibrationResult,
        polished: Polished,
        choice: Choice | None = None,
        restarts: int = 0,
        progress: ProgressCallback | None = None,
    ) -> CalibrationResult:
        """Scan the latency, say what is known, check it.

        Args:
            problem: Recordings and simulator.
            searched: What the search found, or what stands for it.
            polished: Where the fit ended.
            choice: What cross-validation said.
            restarts: Searches after the first.
            progress: Called while the latency is scanned.
        """
        scan = None
        if choice is not None and choice.chosen == "search":
            length, states = polished.shooting.length, polished.shooting.states(polished.point)
            polished = at_estimate(problem, searched, length, states)
        elif problem.fixed_latency_s is None:
            scan = scan_latency(problem, polished, progress)
        whole = scan is not None and scan.polished[scan.best].normal.cost < polished.normal.cost + SCAN_WORSE
        if scan is not None and whole:
            polished = scan.polished[scan.best]
        decided = whole or problem.fixed_latency_s is not None
        if choice is not None and choice.chosen == "robust polish":
            polished = robust_polish(problem, polished, decided)
        polished = with_rows(polished)
        known = statement(problem, polished, fixed_latency=decided)
        if scan is not None and whole:
            known = _average(problem, scan, known)
        known, checked = judge(problem, polished, known, self.settings)
        # What the search says of its own interval does not hold for these.
        provenance = {k: v for k, v in searched.provenance.items() if k != "interval"} | {
            "search": searched.method,
            "search_seconds": searched.seconds,
            "search_estimate": dict(zip(problem.space.names, map(float, searched.estimate), strict=True)),
            "search_latency_s": searched.latency_s,
            "restarts": restarts,
            "window_s": polished.shooting.length * problem.episodes[0].period_s,
            "noise_std": problem.noise.position_std.tolist(),
            "timing_std_s": problem.noise.timing_std_s,
            "polish_iterations": polished.iterations,
            **checked,
        }
        if choice is not None:
            provenance["folds"] = choice.to_json()
        if scan is not None:
            chi2 = [p.chi2 for p in scan.polished]
            provenance["latency_scan"] = {
                "ticks": list(scan.ticks),
                "chi2": chi2,
                "weights": scan.weights.tolist(),
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
            provenance=provenance,
        )

    def _choose(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        searched: CalibrationResult,
        polished: Polished,
        progress: ProgressCallback | None,
    ) -> Choice | None:
        """Return what inner folds say of the polish; None where it explains the recording to its noise."""
        # A fold is a search and a polish; with contacts these take a minute each.
        if not self.settings.folds or problem.robot.base is not None or conclusive(problem, polished):
            return None
        if progress is not None:
            progress(Progress("folds", 0, 1, "does the polish help on what it has not seen?"))
        robust = self.settings.robust and kurtosis(polished.normal.residual) > HEAVY_TAILS
        # Drawn after all searches, so that a resumed run draws the same.
        seed = int(rng.integers(2**32))
        length = polished.shooting.length
        # A fold needs no more generations than the whole did.
        less = dataclasses.replace(budget, generations=max(len(searched.trace), FEWEST_GENERATIONS))
        return choose(problem, self.search, less, seed, length, searched.steps, robust)


def local_fit(problem: Problem, progress: ProgressCallback | None) -> Polished | None:
    """Refine the model's own values; return None where they are too far to be refined.

    Costs a small part of a search. Where its residual is explained by the sensors' noise nothing is left to
    search for. A part of the recordings says where the fit goes; all of them are fitted only where that part
    can be explained.
    """
    fixed = problem.fixed_latency_s is not None
    latency_s = problem.first_latency_s

    def notify(done: int, chi2: float) -> None:
        if progress is not None:
            words = f"from the model's own values: chi2 {chi2:.3g}"
            progress(Progress("local fit", done, done, words, values={"chi2": chi2}))

    def fit(part: Problem, theta: FloatArray, latency_s: float, stages_s: Sequence[float] | None) -> Polished:
        return polish(
            part, theta, latency_s, stages_s, fixed_latency=fixed, notify=notify, shake=problem.exact
        )

    part, nominal = _spread(problem, LOCAL_S), problem.space.nominal
    if part is problem or problem.exact:
        found = fit(problem, nominal, latency_s, None)
        return found if np.isfinite(found.chi2) else None
    short, *longer = CONTACT_STAGES_S if problem.robot.base is not None else STAGES_S
    found = fit(part, nominal, latency_s, (short,))
    if not found.chi2 < LOCAL_HOPELESS:
        return found if np.isfinite(found.chi2) else None
    try:
        return fit(problem, found.theta, found.latency_s, longer)
    except InsufficientDataError:
        # No recording holds a longer window.
        return fit(problem, found.theta, found.latency_s, (short,))


def _spread(problem: Problem, seconds: float) -> Problem:
    """Return the problem with pieces of a second, evenly spread, that add up to about so many seconds."""
    lengths = [len(e.sample) for e in problem.episodes]
    period_s = problem.episodes[0].period_s
    piece = max(round(1.0 / period_s), 1)
    every = max(math.floor(sum(lengths) * period_s / seconds), 1)
    number = np.arange(sum(lengths)) // piece
    kept = np.split(number % every == 0, np.cumsum(lengths)[:-1])
    return problem.part(kept) if every > 1 else problem


def conclusive(problem: Problem, polished: Polished) -> bool:
    """Return whether a fit needs no other judge: what it leaves has the size of the sensors' noise.

    A residual that was chosen explains itself: only what no fit has seen can judge then.
    """
    chosen = problem.known_std is not None and problem.robot.base is None
    return not chosen and not unexplained(polished)


def without_search(problem: Problem, budget: Budget, local: Polished) -> CalibrationResult:
    """Return what stands for a search's result where none was needed."""
    space = problem.space
    return CalibrationResult(
        method="local fit",
        space=space,
        estimate=local.theta,
        interval=np.stack([space.low, space.high], axis=1),
        latency_s=local.latency_s,
        trace=({"generation": 0.0, "chi2": local.chi2},),
        provenance={"budget": dataclasses.asdict(budget)},
    )


def _until_explained(
    attempts: Attempts, problem: Problem, budget: Budget, progress: ProgressCallback | None
) -> tuple[CalibrationResult, Polished, int]:
    best: tuple[CalibrationResult, Polished] | None = None
    attempt, left = 0, budget.generations
    for attempt in range(1 + RESTARTS):
        searched = attempts.run(attempt, dataclasses.replace(budget, generations=left), progress)
        left -= len(searched.trace)
        polished = polish_from(problem, searched, progress)
        previous = best[1].chi2 if best is not None else np.inf
        if best is None or _better(polished, best[1]):
            best = (searched, polished)
        # Two searches that end at the same unexplained residual say that the model is wrong, not the search.
        same = abs(polished.chi2 - previous) < SAME_CHI2 * previous
        if best[1].chi2 < MISMATCH_CHI2 or same or left < FEWEST_GENERATIONS:
            break
    if best is None:
        raise RuntimeError("unreachable: at least one search is run")
    return (*best, attempt)


def _better(a: Polished, b: Polished) -> bool:
    """Say whether ``a`` explains more: a longer window only counts where both are explained."""
    if a.chi2 < MISMATCH_CHI2 and b.chi2 < MISMATCH_CHI2 and a.shooting.length != b.shooting.length:
        return a.shooting.length > b.shooting.length
    return a.chi2 < b.chi2


def polish_from(problem: Problem, searched: CalibrationResult, progress: ProgressCallback | None) -> Polished:
    """Polish a search's estimate."""
    fixed = problem.fixed_latency_s is not None
    latency = searched.latency_s if problem.fixed_latency_s is None else problem.fixed_latency_s

    def notify(done: int, chi2: float) -> None:
        if progress is not None:
            progress(Progress("polish", done, done, f"chi2 {chi2:.3g}", values={"chi2": chi2}))

    def run(settle: bool) -> Polished:
        return polish(problem, searched.estimate, latency, fixed_latency=fixed, notify=notify, settle=settle)

    settled = run(True)
    if problem.exact or problem.robot.base is not None:
        return settled
    # Kinks make several minima (a speed limit for a latency); the two ways to move start states end in
    # different ones often enough to be worth a second polish, which is cheap beside the search.
    free = run(False)
    return free if _better(free, settled) else settled


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
    reach, iterations = (1, CONTACT_ITERATIONS) if contacts else (SCAN_TICKS, SCAN_ITERATIONS)
    if not contacts:
        # In a smooth problem the curvature says how far off a tick is worth a fit.
        worth_s = np.sqrt(SCAN_HOPELESS * max(1.0, polished.chi2) * _latency_variance(polished))
        low = max(low, min(math.ceil((polished.latency_s - worth_s) / tick), centre))
        high = min(high, max(math.floor((polished.latency_s + worth_s) / tick), centre))
    found: dict[int, Polished] = {}
    if problem.exact:
        # That polish was at a whole tick, with more iterations than are spent on its neighbours.
        found[centre] = polished
    waiting = [t for t in range(centre - reach, centre + reach + 1) if low <= t <= high and t not in found]
    while waiting and len(found) < SCAN_MOST:
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


def _average(problem: Problem, scan: LatencyScan, best: Uncertainty) -> Uncertainty:
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
