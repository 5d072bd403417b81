"""Other minima: refinements from drawn points, where a residual is unexplained or has a pattern."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from deal_hw.calib.data.independent import in_order
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import CORRELATION_SAMPLES, EVIDENCE, MISMATCH_CHI2, WHITE_SAMPLES
from deal_hw.calib.fit.refinement import LOCAL_S, Refined, from_start, part_of, window_stages
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray

CONTACT_DRAWN = 0
"""Refinements from drawn points with feet on the floor, where each takes as long as a search."""


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

    def draws(self, problem: Problem) -> int:
        """Return the number of refinements from drawn points."""
        return self.drawn if problem.robot.base is None else CONTACT_DRAWN

    def much_lower(self, a: Refined, b: Refined) -> bool:
        """Return whether ``a`` explains a good part of what ``b`` leaves beyond noise."""
        return b.chi2 - a.chi2 > self.same * (b.chi2 - 1.0)


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


def lower_minimum(
    run: CalibrationRun, found: Refined, settings: RestartSettings, searched: CalibrationResult | None = None
) -> Refined | None:
    """Return the refinement from a drawn point that ends in a lower minimum; None where none does.

    Half of the points are members of the search's last population, if there was a search: a brief one has
    found the neighbourhood, but its mean may lead to a minimum beside the right one. Points are compared on a
    part of the recordings. The first whose residual is white is taken, otherwise the lowest.
    """
    if not settings.draws(run.problem):
        return None
    part, shortest = part_of(run.problem, LOCAL_S), window_stages(run.problem)[:1]
    run_part = dataclasses.replace(run, problem=part)
    # Fixed: a refinement is analysis of the data and must not depend on the search's draws.
    rng = np.random.default_rng(0)
    same = best = refined_from(run_part, found.theta, found.latency_s, shortest)
    # New start states alone may lead lower. Of other windows or data only an explained residual shows it.
    alike = part is run.problem and same.shooting.length == found.shooting.length
    again = clearly_lower(same, found) if alike else same.chi2 < settings.explained <= found.chi2
    starts = [(theta, part.first_latency_s) for theta in part.space.sample(rng, settings.draws(part))]
    if searched is not None and searched.population is not None:
        near = rng.permutation(searched.population)[: len(starts) // 2]
        starts = [(theta, searched.latency_s) for theta in near] + starts[: len(starts) - len(near)]
    fits = in_order(part, partial(from_start, stages_s=shortest), starts)
    done = 0
    while not ((again or best is not same) and conclusive(part, best, WHITE_SAMPLES)):
        if (tried := next(fits, None)) is None:
            break
        done += 1
        if np.isfinite(tried.chi2):
            run.offer("refinement", tried, done, len(starts), "from another point, ")
        if clearly_lower(tried, best):
            best = tried
    fits.close()
    if best is same and not again:
        return None
    lower = refined_from(run, best.theta, best.latency_s)
    return lower if better(lower, found, settings) else None


def refined_from(
    run: CalibrationRun, theta: FloatArray, latency_s: float, stages_s: Sequence[float] | None = None
) -> Refined:
    """Refine from a search's estimate or another start."""
    return from_start(run.problem, (theta, latency_s), stages_s, partial(run.offer, "refinement"))


def conclusive(problem: Problem, fit: Refined, longest: float = CORRELATION_SAMPLES) -> bool:
    """Return whether noise explains the residual of a fit, so that no other check is needed.

    A residual scale that the user chose proves nothing: then only unseen data can judge. ``longest`` is the
    longest autocorrelation time of a residual that counts as noise [samples].
    """
    from deal_hw.calib.validation.checks import unexplained

    chosen = problem.known_std is not None and problem.robot.base is None
    return not chosen and not unexplained(fit, longest)
