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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.baselines.simple import Nominal
from deal_hw.calib.data.problem import Problem, samples_in
from deal_hw.calib.fit.output_error import SHORT, HorizonFit, Recipe, fit_horizon, prediction_rmse
from deal_hw.calib.fit.refinement import Polished, at_parameters
from deal_hw.calib.pipeline import Calibration, Outcome, offer
from deal_hw.calib.search.eki import Weki
from deal_hw.calib.search.restarts import Attempts
from deal_hw.calib.uncertainty.intervals import (
    MISMATCH,
    Uncertainty,
    ended_at_bound,
    mismatch,
    uncertainty,
    with_rows,
)
from deal_hw.calib.uncertainty.null_space import confounded
from deal_hw.calib.validation.cross_validation import (
    Choice,
    Member,
    fold_masks,
    motion_numbers,
    on_folds,
    time_masks,
)
from deal_hw.calib.validation.split_half import Halves, agreement, heed
from deal_hw.calib.validation.verdict import Validation, with_causes, with_step
from deal_hw.calibration import (
    Alarm,
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
)
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.parts import joined, spread, stretches
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenLoopSettings:
    """Settings of `open-loop`.

    Attributes:
        horizons_s: Windows of the fits, one from where the one before ended [s]. What the model lacks pulls
            each horizon's fit elsewhere; their mean may be nearer than any of them.
        search_s: The search is to find the neighbourhood: so much of the recordings, evenly spread, says
            where it is [s].
        stretch_s: Recordings are divided into stretches of this length for it [s].
        folds: Motions are left out in so many turns, a single motion third by third.
        compared_s: Starts are compared in windows of this length: even a far one does not diverge [s].
        half_iterations: Most steps of the fit of each half.
        mismatch_s: Windows in which the model is held against the sensors' noise: start states are fitted, so
            even a residual that needs longer to build up shows as far as it matters to a controller [s].
    """

    horizons_s: tuple[float, ...] = (0.4, 0.8, 1.2, 2.0)
    search_s: float = 12.0
    stretch_s: float = 2.5
    folds: int = 3
    compared_s: float = 0.4
    half_iterations: int = 5
    mismatch_s: float = 0.4

    @property
    def long_s(self) -> float:
        """The longest horizon [s]."""
        return self.horizons_s[-1]


SETTINGS = OpenLoopSettings()

PRIORS: Mapping[str, float] = {"": Recipe().prior_std, ", wide prior": 1.0}
"""How far the model's own values hold, as a share of the range: as far as the range itself, or hardly."""

LONG = Recipe(seconds=SETTINGS.long_s)
VARIANTS: Mapping[str, Recipe] = {
    "long, robust": Recipe(seconds=SETTINGS.long_s, robust=True),
    "long, no latency": Recipe(seconds=SETTINGS.long_s, latency=False),
}


class OpenLoop(Calibration):
    """Searches, fits open-loop predictions, and takes what inner folds say predicts best.

    Args:
        search: The search; `weki` by default.
        folds: Let inner folds choose; otherwise the fit over long horizons is taken.
        local_first: Refine the model's own values first; where that explains the recordings it is the answer.
        name: Name of the whole.
    """

    def __init__(
        self,
        search: CalibrationMethod[Problem] | None = None,
        *,
        folds: bool = True,
        local_first: bool = True,
        name: str = "open-loop",
    ) -> None:
        super().__init__(search or Weki(), name, Validation(local_first=local_first, folds=folds))

    def fitted(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        attempts: Attempts,
        local: Polished | None,
        progress: ProgressCallback | None,
    ) -> Outcome:
        """Search, fit all candidates, take the one that predicts best. See :meth:`Calibration.fitted`."""
        pieces, folds = problem, self.settings.folds
        if folds:
            problem = _whole(problem)
        work = _Work(
            problem, self.search, budget, progress, SETTINGS.horizons_s if folds else (SETTINGS.long_s,)
        )
        work.say("residual", "fits short windows from the model's own values")
        first = fit_horizon(problem, problem.space.nominal, work.given_latency_s, SHORT)
        searched = attempts.run(work.reduced(problem, first), 0, budget, progress)
        offer("search", searched.estimate, searched.latency_s, searched.chi2, progress)
        # Drawn after the search, so that a resumed run draws the same.
        seed = int(rng.integers(2**32))
        choice = work.choose(seed) if folds else Choice("long", {}, SETTINGS.long_s, note="without folds")
        work.say("fit", f"{choice.chosen} on all recordings")
        members = work.members(problem, (first.theta, first.latency_s), searched, choice.chosen)
        theta, latency_s = members[choice.chosen]
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
        left = at_parameters(problem, theta, latency_s, samples_in(problem, SETTINGS.mismatch_s)).normal
        chi2 = left.cost / max(left.count, 1)
        found = confounded(problem, fit.hessian / known.inflation)
        facts |= {
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
        }
        return Outcome(
            searched=searched,
            theta=theta,
            latency_s=latency_s,
            chi2=chi2,
            known=dataclasses.replace(known, alarms=(*known.alarms, *_unexplained(chi2))),
            null_directions=tuple(dict.fromkeys((*known.null_directions, *(pair.words for pair in found)))),
            facts=facts,
            other_steps=work.other_steps + (0 if problem is pieces else problem.steps),
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
        return self._problem.steps - self._before + self.other_steps

    @property
    def other_steps(self) -> int:
        """Physics steps of the reduced problems."""
        return sum(p.steps for p in self._searched)

    def say(self, stage: str, message: str) -> None:
        """Report what is being done."""
        if self._progress is not None:
            self._progress(Progress(stage, 0, 1, message))

    def reduced(self, problem: Problem, first: HorizonFit) -> Problem:
        """Return the search's problem: part of the recordings, and residuals as large as a first fit's."""
        parts = [p for e in problem.episodes for p in stretches(e, SETTINGS.stretch_s)]
        usable = [p for p in parts if p.usable.any()]
        std = problem.known_std
        if std is None:
            std = problem.noise_std.copy()
            std[problem.channels] = np.maximum(std[problem.channels], first.scale)
        found = dataclasses.replace(problem, episodes=spread(usable, SETTINGS.search_s), known_std=std)
        self._searched.append(found)
        return found

    def choose(self, seed: int) -> Choice:
        """Fit every candidate to the data without each fold and compare what they predict of it."""
        problem, before = self._problem, self.steps
        motions = motion_numbers(problem.episodes)[-1] + 1
        masks = (
            time_masks(problem, SETTINGS.folds)
            if motions == 1
            else fold_masks(problem, min(motions, SETTINGS.folds))
        )

        def fits(train: Problem, fold: int) -> dict[str, Member]:
            self.say("folds", f"{fold + 1} of {len(masks)}: which fit predicts what it has not seen?")
            first = fit_horizon(train, problem.space.nominal, self.given_latency_s, SHORT)
            rng = np.random.default_rng([seed, fold])
            searched = self._search.run(self.reduced(train, first), self._budget, rng)
            return self.members(train, (first.theta, first.latency_s), searched)

        def errors(test: Problem, members: Sequence[Member]) -> FloatArray:
            rmse = prediction_rmse(test, members, SETTINGS.long_s)
            return np.array([_error(problem, of_channels) for of_channels in rmse])

        found = on_folds(problem, masks, fits, errors, "long", SETTINGS.long_s)
        return dataclasses.replace(found, steps=self.steps - before)

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
        rmse = prediction_rmse(problem, [found["search"], short], SETTINGS.compared_s)
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
    return uncertainty(
        problem.space,
        fit.theta,
        fit.latency_s,
        fit.hessian,
        1.0,
        fit.residual,
        problem.latency_range_s,
        fixed_latency=problem.fixed_latency_s is not None,
        gradient=fit.gradient,
        prior=fit.prior,
        rows=fit.rows,
    )


def _unexplained(chi2: float) -> tuple[Alarm, ...]:
    if chi2 <= MISMATCH.chi2:
        return ()
    return (mismatch(chi2, f" over {SETTINGS.mismatch_s:g} s from fitted start states"),)


def _halves(problem: Problem, fit: HorizonFit, recipe: Recipe, known: Uncertainty) -> Halves:
    """Fit two halves of the recordings, motion by motion, from the whole's estimate and compare."""
    space, before = problem.space, problem.steps
    estimates, stds, intervals = [], [], []
    for mask in fold_masks(problem, 2):
        try:
            half = fit_horizon(
                problem.part(mask),
                fit.theta,
                fit.latency_s,
                recipe,
                iterations=SETTINGS.half_iterations,
                central=True,
            )
        except InsufficientDataError as err:
            return Halves((), (), np.zeros(len(space)), note=f"a half cannot be fitted: {err}")
        told = _known(problem, half)
        estimates.append(half.theta)
        stds.append(np.sqrt(np.diag(told.covariance)))
        intervals.append(told.interval)
    return agreement(problem, fit.theta, known, estimates, stds, intervals, problem.steps - before)
