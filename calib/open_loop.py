"""`open-loop`: calibration from recordings of a real robot, which no simulator explains to the noise.

Three questions have no answer there that holds for every robot: how far a prediction may be off, whether a
search that stops early or a fit that goes on predicts other motion better, and over which horizon to fit. So

1. a fit from the model's own values over short windows says what residuals to expect;
2. the ensemble search (:mod:`deal_hw.calib.search.eki`) is run with these;
3. on inner folds of the recordings that are fitted, motion by motion, the search's estimate, fits over short
   and long horizons (robust or not, with a latency or none, held to the model's own values or hardly) and the
   mean of fits over all horizons predict what they have not seen;
4. what predicts best is fitted to all, its halves are compared, and what goes with what is said.

Recordings that are held out take no part in any of this.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from deal_hw.calib.baselines.simple import Nominal
from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.output_error import SHORT, HorizonFit, Recipe, fit_horizon, prediction_rmse
from deal_hw.calib.fit.refinement import mismatch
from deal_hw.calib.pipeline import PolishedMethod, conclusive, local_fit, without_search
from deal_hw.calib.search.eki import Weki
from deal_hw.calib.search.restarts import Attempts
from deal_hw.calib.uncertainty.at_fit import with_rows
from deal_hw.calib.uncertainty.correlated import confounded
from deal_hw.calib.uncertainty.intervals import MISMATCH_CHI2, Uncertainty, ended_at_bound, uncertainty
from deal_hw.calib.validation.checks import with_causes, with_step
from deal_hw.calib.validation.cross_validation import Choice, fold_masks, motion_numbers, time_masks
from deal_hw.calib.validation.split_half import FALSE_ALARMS, Halves, HalvesRow, heed
from deal_hw.calibration import (
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.sim.episode_parts import joined, spread, stretches
from deal_hw.types import FloatArray

LONG_S = 2.0
SEARCH_S = 12.0
"""The search is to find the neighbourhood: so much of the recordings, evenly spread, says where it is [s]."""

STRETCH_S = 2.5
MOST_FOLDS = 3
"""Motions are left out in so many turns, a single motion third by third."""

SEARCHED_WINDOW_S = 0.4
"""Starts are compared in windows of this length: even a far one does not diverge in them."""

HALF_ITERATIONS = 5

MISMATCH_S = 0.4
"""Windows in which the model is held against the sensors' noise [s]: start states are fitted, so even a
residual that needs longer to build up shows as far as it matters to a controller."""

HORIZONS_S = (0.4, 0.8, 1.2, LONG_S)
"""What the model lacks pulls each horizon's fit elsewhere; their mean may be nearer than any of them."""

PRIORS: Mapping[str, float] = {"": Recipe().prior_std, ", wide prior": 1.0}
"""How far the model's own values hold, as a share of the range: as far as the range itself, or hardly."""

LONG = Recipe(seconds=LONG_S)
VARIANTS: Mapping[str, Recipe] = {
    "long, robust": Recipe(seconds=LONG_S, robust=True),
    "long, no latency": Recipe(seconds=LONG_S, latency=False),
}

Member = tuple[FloatArray, float]


class OpenLoop(CalibrationMethod[Problem]):
    """Searches, fits open-loop predictions, and takes what inner folds say predicts best.

    Args:
        search: The search; `weki` by default.
        folds: Let inner folds choose; otherwise the fit over long horizons is taken.
        local_first: Refine the model's own values first; where that explains the recordings it is the answer.
        name: Name of the whole.
    """

    name = "open-loop"

    def __init__(
        self,
        search: CalibrationMethod[Problem] | None = None,
        *,
        folds: bool = True,
        local_first: bool = True,
        name: str = "open-loop",
    ) -> None:
        self.search: CalibrationMethod[Problem] = search or Weki()
        self.folds, self.local_first, self.name = folds, local_first, name

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Calibrate. See :meth:`CalibrationMethod.run`.

        A resumed run takes the search of all data from the checkpoint; the rest is done again, to the same
        numbers.
        """
        began, before = time.perf_counter(), problem.steps
        check_excitation(problem)
        local = local_fit(problem, progress) if self.local_first else None
        if local is not None and conclusive(problem, local):
            explained = PolishedMethod(self.search, self.name).concluded(
                problem, without_search(problem, budget, local), local, progress=progress
            )
            return dataclasses.replace(
                explained, steps=problem.steps - before, seconds=time.perf_counter() - began
            )
        pieces, local_steps = problem, problem.steps - before
        if self.folds:
            problem = _whole(problem)
        work = _Work(problem, self.search, budget, progress, HORIZONS_S if self.folds else (LONG_S,))
        work.say("residual", "fits short windows from the model's own values")
        first = fit_horizon(problem, problem.space.nominal, work.given_latency_s, SHORT)
        reduced = work.reduced(problem, first)
        attempts = Attempts(self.search, reduced, rng, checkpoint)
        searched = attempts.run(0, budget, progress)
        # Drawn after the search, so that a resumed run draws the same.
        seed = int(rng.integers(2**32))
        choice = work.choose(seed) if self.folds else Choice("long", {}, LONG_S, note="without folds")
        work.say("fit", f"{choice.chosen} on all recordings")
        theta, latency_s = work.members(problem, (first.theta, first.latency_s), searched, choice.chosen)[
            choice.chosen
        ]
        recipe = _recipe(choice.chosen)
        told = dataclasses.replace(recipe, latency=True)
        fit = fit_horizon(problem, theta, latency_s, told, iterations=0, central=True)
        known = _known(problem, fit)
        halves = _halves(problem, fit, recipe, known)
        known = heed(problem, known, theta, halves)
        facts: dict[str, Any] = {}
        if local is not None:
            # Windows whose start states are fitted show what the model lacks, not what smoothing lacks.
            local = with_rows(local)
            known, facts["physics_step"] = with_step(pieces, local, known, theta)
            known, facts["diagnosis"] = with_causes(pieces, local, known)
        left = mismatch(problem, theta, latency_s, MISMATCH_S)
        chi2 = left.cost / max(left.count, 1)
        found = confounded(problem, fit.hessian / known.inflation)
        words = tuple(dict.fromkeys((*known.null_directions, *(pair.words for pair in found))))
        provenance = {k: v for k, v in searched.provenance.items() if k != "interval"} | {
            "search": searched.method,
            "search_seconds": searched.seconds,
            "search_estimate": dict(zip(problem.space.names, map(float, searched.estimate), strict=True)),
            "search_latency_s": searched.latency_s,
            "folds": choice.to_json(),
            "residual_std": dict(zip(problem.channel_names, map(float, first.scale), strict=True)),
            "prediction_rmse": dict(zip(problem.channel_names, map(float, fit.scale), strict=True)),
            "window_s": recipe.seconds,
            "noise_std": problem.noise_std[problem.channels].tolist(),
            "inflation": known.inflation,
            "at_bound": [
                problem.space.names[k] for k in np.flatnonzero(ended_at_bound(problem.space, theta))
            ],
            "halves": halves.to_json(),
            "confounded": [pair.to_json() for pair in found],
            **facts,
        }
        return dataclasses.replace(
            searched,
            method=self.name,
            estimate=theta,
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=words,
            latency_s=latency_s,
            latency_interval_s=known.latency_interval_s,
            chi2=chi2,
            alarms=(*known.alarms, *_unexplained(chi2)),
            steps=work.steps + (local_steps if pieces is problem else pieces.steps - before),
            seconds=time.perf_counter() - began + attempts.earlier_seconds,
            provenance=provenance,
        )


def near() -> OpenLoop:
    """Return `near`: the fits over short and then long horizons alone, from the model's own values.

    For a robot whose model is near (within a factor two or so) and in which motion is damped: it costs a
    twentieth of a search. What its residual does not explain it says like `open-loop`.
    """
    return OpenLoop(Nominal(), folds=False, name="near")


def _whole(problem: Problem) -> Problem:
    """Return the problem with stretches that follow each other in one piece, so that long windows fit."""
    episodes = joined(problem.episodes)
    if len(episodes) < len(problem.episodes):
        return dataclasses.replace(problem, episodes=episodes)
    return problem


class _Work:
    """One run: what every fold does again.

    Args:
        problem: All recordings that are fitted.
        search: The search.
        budget: What it may use.
        progress: Called now and then.
        horizons_s: Horizons that are fitted, one from where the one before ended [s].
    """

    def __init__(
        self,
        problem: Problem,
        search: CalibrationMethod[Problem],
        budget: Budget,
        progress: ProgressCallback | None,
        horizons_s: Sequence[float],
    ) -> None:
        self._horizons_s = horizons_s
        self._problem, self._search, self._budget, self._progress = problem, search, budget, progress
        self._before = problem.steps
        self._searched: list[Problem] = []

    @property
    def given_latency_s(self) -> float:
        """The latency where it is given; otherwise fits begin at the least that is searched [s]."""
        return self._problem.first_latency_s

    @property
    def steps(self) -> int:
        """Physics steps so far, those of the reduced problems too."""
        return self._problem.steps - self._before + sum(p.steps for p in self._searched)

    def say(self, stage: str, message: str) -> None:
        """Report what is being done."""
        if self._progress is not None:
            self._progress(Progress(stage, 0, 1, message))

    def reduced(self, problem: Problem, first: HorizonFit) -> Problem:
        """Return the search's problem: part of the recordings, and residuals as large as a first fit's."""
        parts = [p for e in problem.episodes for p in stretches(e, STRETCH_S)]
        usable = [p for p in parts if p.usable.any()]
        std = problem.known_std
        if std is None:
            std = problem.noise_std.copy()
            std[problem.channels] = np.maximum(std[problem.channels], first.scale)
        found = dataclasses.replace(problem, episodes=spread(usable, SEARCH_S), known_std=std)
        self._searched.append(found)
        return found

    def choose(self, seed: int) -> Choice:
        """Fit every candidate to the data without each fold and compare what they predict of it."""
        problem, before = self._problem, self.steps
        errors: dict[str, list[float]] = {}
        motions = motion_numbers(problem.episodes)[-1] + 1
        masks = (
            time_masks(problem, MOST_FOLDS) if motions == 1 else fold_masks(problem, min(motions, MOST_FOLDS))
        )
        for fold, left_out in enumerate(masks):
            self.say("folds", f"{fold + 1} of {len(masks)}: which fit predicts what it has not seen?")
            train, test = problem.part([~m for m in left_out]), problem.part(left_out)
            try:
                first = fit_horizon(train, problem.space.nominal, self.given_latency_s, SHORT)
                searched = self._search.run(
                    self.reduced(train, first), self._budget, np.random.default_rng([seed, fold])
                )
                members = self.members(train, (first.theta, first.latency_s), searched)
                rmse = prediction_rmse(test, list(members.values()), LONG_S)
            except (InsufficientDataError, CalibrationError) as err:
                return Choice("long", {}, LONG_S, note=f"a fold's data cannot be fitted: {err}")
            for name, of_channels in zip(members, rmse, strict=True):
                errors.setdefault(name, []).append(_error(problem, of_channels))
        means = {name: float(np.mean(np.log(values))) for name, values in errors.items()}
        chosen = min(means, key=lambda name: means[name])
        return Choice(chosen, {n: tuple(v) for n, v in errors.items()}, LONG_S, self.steps - before)

    def members(
        self, problem: Problem, short: Member, searched: CalibrationResult, only: str | None = None
    ) -> dict[str, Member]:
        """Return what each candidate makes of a problem.

        Args:
            problem: All data, or those of a fold.
            short: The fit over short windows.
            searched: The search's result.
            only: Name of the one candidate that is wanted; None for all.
        """
        found: dict[str, Member] = {"search": (searched.estimate, searched.latency_s), "short": short}
        rmse = prediction_rmse(problem, [found["search"], short], SEARCHED_WINDOW_S)
        start = list(found.values())[int(np.argmin(np.mean(np.log(rmse), axis=1)))]
        for words, prior_std in PRIORS.items():
            if only is not None and words != _prior_words(only):
                continue
            horizons = [start]
            for seconds in self._horizons_s:
                recipe = Recipe(seconds=seconds, prior_std=prior_std)
                horizons.append(_member(fit_horizon(problem, *horizons[-1], recipe)))
            for seconds, member in zip(self._horizons_s[:-1], horizons[1:], strict=False):
                found[f"{seconds:g} s{words}"] = member
            found["long" + words] = horizons[-1]
            found["mean of horizons" + words] = _mean(problem, horizons[1:])
        for name, recipe in VARIANTS.items():
            if only in (None, name):
                theta, latency_s = found["long"]
                latency_s = latency_s if recipe.latency else self.given_latency_s
                found[name] = _member(fit_horizon(problem, theta, latency_s, recipe))
        return found


def _prior_words(name: str) -> str:
    """Return which of the priors a candidate's name ends with."""
    return next((words for words in PRIORS if words and name.endswith(words)), "")


def _recipe(name: str) -> Recipe:
    """Return how a candidate's residuals are weighed, for intervals and halves."""
    return VARIANTS.get(name, dataclasses.replace(LONG, prior_std=PRIORS[_prior_words(name)]))


def _error(problem: Problem, rmse: FloatArray) -> float:
    """Return the mean error of channels, (M,); the geometric one where their units differ."""
    C, units = problem.coordinates, problem.robot.coordinate_units
    if len({units[c % C] + "/s" * int(c >= C) for c in problem.channels}) == 1:
        return float(np.mean(rmse))
    return float(np.exp(np.mean(np.log(rmse))))


def _member(fit: HorizonFit) -> Member:
    return fit.theta, fit.latency_s


def _mean(problem: Problem, members: Sequence[Member]) -> Member:
    """Return the mean of estimates, parameters in their own scale."""
    scaled = [problem.space.to_scale(theta) for theta, _ in members]
    theta = problem.space.from_scale(np.mean(scaled, axis=0))
    return theta, float(np.mean([latency_s for _, latency_s in members]))


def _known(problem: Problem, fit: HorizonFit) -> Uncertainty:
    prior = np.append(1 / problem.space.prior[1] ** 2, 0.0)
    return uncertainty(
        problem.space,
        fit.theta,
        fit.latency_s,
        fit.hessian + np.diag(prior),
        1.0,
        fit.residual,
        problem.latency_range_s,
        fixed_latency=problem.fixed_latency_s is not None,
        gradient=fit.gradient,
        prior=prior,
        rows=fit.rows,
    )


def _unexplained(chi2: float) -> tuple[str, ...]:
    if chi2 <= MISMATCH_CHI2:
        return ()
    return (
        f"the model does not explain the recordings to their noise: over {MISMATCH_S:g} s, from fitted start "
        f"states, predictions are off by {np.sqrt(chi2):.1f} times the sensor's noise; the intervals count "
        "all of it as noise",
    )


def _halves(problem: Problem, fit: HorizonFit, recipe: Recipe, known: Uncertainty) -> Halves:
    """Fit two halves of the recordings, motion by motion, from the whole's estimate and compare."""
    space, before = problem.space, problem.steps
    estimates, stds, intervals = [], [], []
    for mask in fold_masks(problem, 2):
        try:
            half = fit_horizon(
                problem.part(mask), fit.theta, fit.latency_s, recipe, iterations=HALF_ITERATIONS, central=True
            )
        except InsufficientDataError as err:
            return Halves((), (), np.zeros(len(space)), note=f"a half cannot be fitted: {err}")
        told = _known(problem, half)
        estimates.append(half.theta)
        stds.append(np.sqrt(np.diag(told.covariance)))
        intervals.append(told.interval)
    return compared(problem, fit.theta, known, estimates, stds, intervals, problem.steps - before)


def compared(
    problem: Problem,
    theta: FloatArray,
    known: Uncertainty,
    estimates: list[FloatArray],
    stds: list[FloatArray],
    intervals: list[FloatArray],
    steps: int,
) -> Halves:
    """Return whether two halves agree.

    Args:
        problem: All data.
        theta: The estimate of all data, (K,).
        known: What is known there; what the data cannot tell is not compared.
        estimates: Of each half, (K,).
        stds: Of each half, in the parameters' own scale, (K,).
        intervals: Of each half, (K, 2).
        steps: Physics steps that it cost.
    """
    space = problem.space

    def three(half: int, k: int) -> tuple[float, float, float]:
        low, high = intervals[half][k]
        return float(estimates[half][k]), float(low), float(high)

    rows = tuple(HalvesRow(name=n, first=three(0, k), second=three(1, k)) for k, n in enumerate(space.names))
    told = ~known.shape.blind
    least = norm.ppf(1 - FALSE_ALARMS / (2 * max(int(told.sum()), 1)))
    scaled = space.to_scale(np.stack(estimates))
    far = np.abs(scaled[0] - scaled[1]) > least * np.hypot(*stds)
    flagged = tuple(r.name for k, r in enumerate(rows) if far[k] and told[k] and not r.agree)
    return Halves(rows, flagged, np.max(np.abs(scaled - space.to_scale(theta)), axis=0), steps)
