"""Other minima: refinements from drawn points, where a residual is unexplained or has a pattern."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from deal_hw.calib.data.independent import in_order
from deal_hw.calib.data.parts import BEGIN_S, part_of
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import CORRELATION_SAMPLES, MISMATCH_CHI2, WHITE_SAMPLES
from deal_hw.calib.fit.refinement import Refined, from_start, window_stages
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

CONTACT_DRAWN = 0
"""Refinements from drawn points with feet on the floor, where each takes as long as a search."""
UNSEEN = 0.1
"""No more points are drawn below this expected share of points whose minima no fit has found: where five fits
end alike, or nine in two minima. See :func:`unseen`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartSettings:
    """When to repeat a search from other random draws.

    Attributes:
        restarts: Most searches after the first.
        same: Relative difference of chi2 below which two searches agree. Then the model is wrong, not the
            search. Also the share of what noise does not explain by which a drawn point must end lower.
        fewest_generations: Fewest generations left in the budget for another search.
        explained: Chi2 below which noise explains the recordings, and no search follows.
        drawn: Most refinements from other points, before another search: half from members of the search's
            population, half drawn in the ranges. On cart-poles whose nominal values lead to another minimum,
            about one in four of the latter leads to the truth. Where none of 8 did (1 to 4 s of balancing,
            noise-free), one of the first three members did.
    """

    restarts: int = 2
    same: float = 0.2
    fewest_generations: int = 15
    explained: float = MISMATCH_CHI2
    drawn: int = 8
    alike_ends: bool = False

    def draws(self, problem: Problem) -> int:
        """Return the number of refinements from drawn points."""
        return self.drawn if problem.robot.base is None else CONTACT_DRAWN

    def agree(self, a: Refined, b: Refined) -> bool:
        """Return whether two fits leave the same residual, and that is enough."""
        low, high = sorted([a.chi2, b.chi2])
        return self.alike_ends and high - low < self.same * low

    def much_lower(self, a: Refined, b: Refined) -> bool:
        """Return whether ``a`` explains a good part of what ``b`` leaves beyond noise."""
        return b.chi2 - a.chi2 > self.same * (b.chi2 - 1.0)


def unseen(levels: Sequence[float], same: float) -> float:
    """Return the share of drawn points that are expected to lead to minima which no fit has found yet [-].

    The stopping rule of multi-start searches: of n fits that end in w minima it is w (w + 1) / (n (n - 1))
    (Boender and Rinnooy Kan, Mathematical Programming 37, 1987, with equal priors).

    Args:
        levels: Chi2 at which each fit ended, (n,); infinite where it diverged.
        same: Relative difference of what noise does not explain below which two fits end alike: then
            one is as good a simulator as the other.
    """
    fits, minima, lowest = len(levels), 0, -np.inf
    for level in sorted(levels):
        if not minima or level > lowest + same * max(lowest - 1.0, 0.0):
            minima, lowest = minima + 1, level
    return 1.0 if fits < 2 else minima * (minima + 1) / (fits * (fits - 1))


RESTARTS = RestartSettings()
ONE_SEARCH = RestartSettings(restarts=0, drawn=0)


def better(a: Refined, b: Refined, settings: RestartSettings) -> bool:
    """Return whether ``a`` is the better fit; window length counts only where both are explained."""
    both = all(fit.chi2 < settings.explained for fit in (a, b))
    if both and a.shooting.length != b.shooting.length:
        return a.shooting.length > b.shooting.length
    return a.chi2 < b.chi2


def clearly_lower(a: Refined, b: Refined) -> bool:
    """Return whether ``a`` has less residual than ``b``, by more than noise makes, on the same windows."""
    return bool(a.normal.count * np.log(b.chi2 / a.chi2) > EVIDENCE)


def refined_search(
    run: CalibrationRun, searched: CalibrationResult, settings: RestartSettings
) -> tuple[Refined, bool]:
    """Refine a brief search's estimate, and other points where noise does not explain what is left.

    Return the lowest fit, and whether no other point ended much lower: then the model is wrong, not the
    search. Far above the noise each ends a little lower or higher, and that is no reason for another search,
    of minutes. Of long recordings a part decides where to begin, and all of them are refined once.
    """
    part, start = part_of(run.problem, BEGIN_S), (searched.estimate, searched.latency_s)
    if part is not run.problem and settings.draws(run.problem):
        on_part = dataclasses.replace(run, problem=part)
        begun = refined_from(on_part, *start, _shortest(run))
        if run.local is not None and settings.agree(run.local, begun):
            return run.local, True
        # The local fit of the same windows, which had no reason to go on to longer ones.
        if run.local is not None and run.local.normal.count == begun.normal.count:
            begun = run.local if clearly_lower(run.local, begun) else begun
        if begun.chi2 >= settings.explained:
            best = _lowest(on_part, begun, settings, searched)
            refined = refined_from(run, best.theta, best.latency_s)
            return refined, not settings.much_lower(best, begun)
        start = begun.theta, begun.latency_s
    refined = refined_from(run, *start)
    if refined.chi2 < settings.explained or not settings.draws(run.problem):
        return refined, False
    if run.local is not None and settings.agree(run.local, refined):
        return min(run.local, refined, key=lambda fit: fit.chi2), True
    lower = lower_minimum(run, refined, settings, searched)
    return lower or refined, lower is None or not settings.much_lower(lower, refined)


def lower_minimum(
    run: CalibrationRun, found: Refined, settings: RestartSettings, searched: CalibrationResult | None = None
) -> Refined | None:
    """Return the refinement from a drawn point that ends in a lower minimum; None where none does.

    Points are compared on a part of the recordings.
    """
    if not settings.draws(run.problem):
        return None
    part = part_of(run.problem, BEGIN_S)
    on_part = dataclasses.replace(run, problem=part)
    same = refined_from(on_part, found.theta, found.latency_s, _shortest(run))
    # New start states alone may lead lower. Of other windows or data only an explained residual shows it.
    alike = part is run.problem and same.shooting.length == found.shooting.length
    again = clearly_lower(same, found) if alike else same.chi2 < settings.explained <= found.chi2
    best = _lowest(on_part, same, settings, searched, enough=again)
    if best is same and not again:
        return None
    lower = refined_from(run, best.theta, best.latency_s)
    return lower if better(lower, found, settings) else None


def gains_on_part(run: CalibrationRun, wider: Problem, fit: Refined) -> bool:
    """Return whether another problem explains a part of long recordings better, from a fit of them all.

    True for short ones, which have no part. Fits of a part in short windows take a small share of the time.
    """
    before, after = part_of(run.problem, BEGIN_S), part_of(wider, BEGIN_S)
    if before is run.problem:
        return True
    start = fit.theta, fit.latency_s
    least, found = (from_start(part, start, _shortest(run)) for part in (before, after))
    return clearly_lower(found, least)


def _shortest(run: CalibrationRun) -> Sequence[float]:
    return window_stages(run.problem)[:1]


def _lowest(
    on_part: CalibrationRun,
    same: Refined,
    settings: RestartSettings,
    searched: CalibrationResult | None,
    *,
    enough: bool = False,
) -> Refined:
    """Return the lowest of a fit and the refinements from drawn points, in short windows.

    Half of the points are members of the search's last population, if there was a search: a brief one has
    found the neighbourhood, but its mean may lead to a minimum beside the right one. The first whose residual
    is white is taken, with ``enough`` also the fit itself. No more are drawn once nearly all points would
    lead to minima that are known.
    """
    part, best = on_part.problem, same
    # Fixed: a refinement is analysis of the data and must not depend on the search's draws.
    rng = np.random.default_rng(0)
    starts = [(theta, part.first_latency_s) for theta in part.space.sample(rng, settings.draws(part))]
    if searched is not None and searched.population is not None:
        near = rng.permutation(searched.population)[: len(starts) // 2]
        # In turn, so that the first few are of both kinds.
        starts[: 2 * len(near) : 2] = [(theta, searched.latency_s) for theta in near]
    fits = in_order(part, partial(from_start, stages_s=_shortest(on_part)), starts)
    levels = [same.chi2]
    while not ((enough or best is not same) and conclusive(part, best, WHITE_SAMPLES)):
        if unseen(levels, settings.same) <= UNSEEN or (tried := next(fits, None)) is None:
            break
        levels.append(tried.chi2)
        if np.isfinite(tried.chi2):
            on_part.offer("refinement", tried, len(levels) - 1, len(starts), "from another point, ")
        if clearly_lower(tried, best):
            best = tried
    fits.close()
    return best


def refined_from(
    run: CalibrationRun, theta: FloatArray, latency_s: float, stages_s: Sequence[float] | None = None
) -> Refined:
    """Refine from a search's estimate or another start."""
    return from_start(run.problem, (theta, latency_s), stages_s, partial(run.offer, "refinement"))


def conclusive(
    problem: Problem, fit: Refined, longest: float = CORRELATION_SAMPLES, chance: float | None = None
) -> bool:
    """Return whether noise explains the residual of a fit, so that no other check is needed.

    A residual scale that the user chose proves nothing: then only unseen data can judge. ``longest`` is the
    longest autocorrelation time of a residual that counts as noise [samples]; with a ``chance``, a longer one
    counts where it may be by that chance.
    """
    from deal_hw.calib.validation.checks import unexplained

    chosen = problem.known_std is not None and problem.robot.base is None
    return not chosen and not unexplained(fit, longest, chance)
