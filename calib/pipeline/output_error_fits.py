"""Output-error fits for recordings of a real robot, which no simulator explains down to the noise.

The right residual scale, the right window length, and whether to stop early differ between robots. So:

1. A fit over short windows from the nominal values measures the size of the residuals. Fits over longer
   windows continue from it. Both are shown at once.
2. The search runs with this residual scale. If its estimate predicts short windows better than the first fit,
   the longer windows are fitted again from there.
3. Cross-validation over the motions compares candidates by their prediction of unseen data. Candidates are
   the fits over short and long windows, that over the longest ones with a robust loss or without a latency,
   the search's estimate if it was the better start, and fits with a law that the model lacks.
4. The best candidate is fitted to all data. If its laws leave only noise, the result is the exact fit, of
   start states, too. Otherwise two halves of the data are compared, and confounded parameters are listed.

Held-out recordings take no part in any of this.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, Uncertainty, names_at_bound, uncertainty_at, with_rows
from deal_hw.calib.fit.null_space import confounded
from deal_hw.calib.fit.output_error import (
    SECANTS,
    SHORT,
    OutputErrorFit,
    Recipe,
    fit_output_error,
    prediction_rmse,
    standing_rmse,
)
from deal_hw.calib.fit.refinement import LOCAL_HOPELESS, Refined, at_parameters
from deal_hw.calib.fit.unexplained import Unexplained
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2
from deal_hw.calib.pipeline.calibration_run import AFTER_FIT, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.stages import CalibrationPipeline, Fits, Refinement
from deal_hw.calib.pipeline.wider_ranges import fit_beyond_ends
from deal_hw.calib.search.no_data import nominal
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Z90, Budget, CalibrationMethod, CalibrationResult
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.parts import joined, spread, stretches
from deal_hw.task_map import InThisProcess
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    from deal_hw.calib.data.folds import Choice
    from deal_hw.calib.data.noise import Mask
    from deal_hw.calib.hypotheses.candidates import Diagnosed
    from deal_hw.calib.hypotheses.trials import Allows
    from deal_hw.calib.pipeline.law_choice import LawCandidate, LawfulChoice
    from deal_hw.calib.validation.checks import SplitHalf

# What follows the fits is imported where it is used, as in stages.py.

SEARCH_S = 12.0
"""Length of data for the search, spread evenly over the recordings [s]. The search only has to find the
neighbourhood."""

FOLDS = 3
"""Number of folds over the motions; a single motion is split in time."""

FOLD_DERIVATIVES = 2
"""Most derivatives of a fit without a law in a fold. It begins in the minimum of all recordings. On the real
SO-101 its error in a fold was then within 7 % of that after up to 24, and the same candidate was chosen.
After one it still knew what was left out (up to 10 % below), and another one was chosen."""

HALF_DERIVATIVES = 2
"""Most derivatives of the fit of each half, which begins in the minimum of all recordings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputErrorSettings:
    """Settings of :class:`OutputErrorFits`.

    Attributes:
        windows_s: Windows of the fits [s]; each fit starts where the one before ended. Model error biases
            each window length differently.
        search_always: Search whatever the fits explain; otherwise only where their predictions over
            ``compared_s`` are no better than a robot whose state stays as it is.
        stretch_s: Recordings are divided into stretches of this length for the search [s].
        compared_s: Window in which start points are compared [s]; short, so that poor ones do not diverge.
        mismatch_s: Windows with fitted start states in which the residual is compared with the sensors' noise
            [s]. Errors that build up more slowly do not matter to a controller. 0: the fit's own residual,
            from smoothed start states.
        first: The fit from the nominal values that measures the residuals.
        robust: Large residuals weigh less (Huber) in all fits.
        fitted_s: Length of data that is fitted, spread evenly in stretches [s]; infinite for all.
        hold_first: Intervals include the first fit's estimate, and the covariance its distance, because model
            error biases each window length differently.
        common_std: Kinds of parameters whose values may be off by one common factor that the recordings do
            not show, and its relative standard deviation [-].
    """

    windows_s: tuple[float, ...] = (0.4, 0.8, 1.2, 2.0)
    search_always: bool = True
    stretch_s: float = 2.5
    compared_s: float = 0.4
    mismatch_s: float = 0.4
    first: Recipe = SHORT
    robust: bool = False
    fitted_s: float = np.inf
    hold_first: bool = False
    common_std: tuple[tuple[tuple[str, ...], float], ...] = ()

    @property
    def long_s(self) -> float:
        """The longest window [s]."""
        return self.windows_s[-1]

    @property
    def variants(self) -> Mapping[str, Recipe]:
        """Other fits over the longest window, by name."""
        return {
            "long, robust": Recipe(seconds=self.long_s, robust=True),
            "long, no latency": Recipe(seconds=self.long_s, latency=False),
        }

    def recipe(self, name: str) -> Recipe:
        """Return the residual weights of a candidate, for intervals and the split-half check."""
        return self.variants.get(name, Recipe(seconds=self.long_s, robust=self.robust))


@dataclass(frozen=True)
class OutputErrorFits(Fits):
    """A search, candidate fits, and the choice of the best predictor by cross-validation.

    Attributes:
        settings: The settings.
        first: The fits from the nominal values, once they are made: of short windows, then of growing ones.
        given: Result of a search that was made before; those fits begin where its refinement ended.
    """

    settings: OutputErrorSettings = field(default_factory=OutputErrorSettings)
    first: tuple[OutputErrorFit, ...] = ()
    given: CalibrationResult | None = None

    def started(self, run: CalibrationRun) -> OutputErrorFits:
        """Fit short and long windows from the nominal values. See :meth:`Fits.started`."""
        settings, problem = self.settings, run.problem
        if run.settings.cross_validation:
            problem = _joined_stretches(problem)
        if np.isfinite(settings.fitted_s):
            problem = problem.on(self._spread(problem, settings.fitted_s), problem.known_std)
        run.say("residual", "fits short windows from the model's own values")
        short = fit_output_error(problem, problem.space.nominal, problem.first_latency_s, settings.first)
        run.offer("fit of short windows", short)
        windows = self._windows(run, problem, short.member)
        run.offer("fit of long windows", windows[-1])
        return dataclasses.replace(self, first=(short, *windows))

    def continued(self, run: CalibrationRun, searched: CalibrationResult, refined: Refined) -> FitOutcome:
        """Fit predictions from where a search's refinement ended, and take the best predictor.

        The residual of the refinement, whose start states are fitted, is that of the diagnosis.
        """
        problem = _joined_stretches(run.problem)
        short = fit_output_error(problem, refined.theta, refined.latency_s, self.settings.first)
        windows = self._windows(run, problem, short.member)
        run.offer("fit of long windows", windows[-1])
        fits = dataclasses.replace(self, first=(short, *windows), given=searched)
        return fits.best(dataclasses.replace(run, local=refined))

    def best(self, run: CalibrationRun) -> FitOutcome:
        """Search, fit all candidates, take the best predictor. See :meth:`Fits.best`."""
        from deal_hw.calib.data.folds import Choice
        from deal_hw.calib.hypotheses.candidates import ranked
        from deal_hw.calib.hypotheses.diagnosis import diagnose
        from deal_hw.calib.hypotheses.laws import HYPOTHESES
        from deal_hw.calib.hypotheses.trials import refused
        from deal_hw.calib.pipeline.law_choice import (
            LawfulChoice,
            ScreenedLaws,
            explained_by_laws,
            screened_laws,
            take_laws,
        )
        from deal_hw.calib.validation import checks

        settings, (first, *windows) = self.settings, self.first or self.started(run).first
        # The recordings as they are fitted, which may be joined or a part, in ranges that may have grown.
        problem = windows[-1].plain.problem
        # The fits continue from the search's estimate, so it only has to find the neighbourhood.
        run = dataclasses.replace(run, budget=dataclasses.replace(run.budget, brief=True))
        searched = self.given or self._searched(run, problem, first, windows)
        run.offer("search", searched)
        # Drawn after the search, so that a resumed run draws the same seed.
        seed = int(run.rng.integers(2**32))
        better = self.given is None and self._better_start(problem, first, searched)
        if better:
            windows = self._windows(run, problem, (searched.estimate, searched.latency_s))
            problem = windows[-1].plain.problem
        decided = LawfulChoice(Choice("long", {}, settings.long_s, note="without folds"))
        screened, lengths = ScreenedLaws(), (windows[0].recipe.seconds, settings.long_s)
        if run.settings.cross_validation:
            own = problem.space.nominal, problem.first_latency_s
            screened = screened_laws(run, problem, [windows[0].member, own], lengths)
            decided = self._choose(run, problem, seed, (first, *windows), screened.chosen, search=better)
        laws = take_laws(run, problem, (screened, decided), partial(self._with_laws, run), lengths)
        choice = laws.made
        if laws.member is None:
            run.say("fit", f"{choice.chosen} on all recordings")
            searched_start = searched if better else None
            members = self._members(problem, first, windows, searched_start, choice.chosen)
            theta, latency_s = members[choice.chosen]
        else:
            problem, (theta, latency_s) = laws.problem, laws.member
            # The local fit knows of no law.
            run = dataclasses.replace(run, problem=laws.widened(run.problem), local=None)
        chi2, left = np.nan, None
        if settings.mismatch_s:
            # With fitted start states the residual shows model error, not smoothing error.
            left = at_parameters(problem, theta, latency_s, samples_in(problem, settings.mismatch_s))
            chi2 = left.normal.cost / max(left.normal.count, 1)
            if chi2 <= FAR_CHI2 and (exact := explained_by_laws(run, searched, laws)):
                return exact
        recipe = settings.recipe(choice.chosen)
        with_latency = dataclasses.replace(recipe, latency=True)
        fit = fit_output_error(problem, theta, latency_s, with_latency, iterations=0, central=True)
        known = uncertainty_at(problem, fit, own_scale=True)
        chi2 = fit.chi2 if left is None else chi2
        run.offer_fitted(problem.space, fit, chi2, known)
        local = None if run.local is None else with_rows(run.local)
        found: Diagnosed | None = None
        judged = run.problem, local
        with run.check(AFTER_FIT):
            if (local is not None or laws.choices) and left is not None:
                # A local fit that diverged has seen only a part of the recordings.
                lost = local is None or local.chi2 >= LOCAL_HOPELESS
                judged = (problem, with_rows(left)) if lost else (run.problem, local)
                of, shown = judged
                if shown is not None and checks.unexplained(shown):
                    allows: Allows = run.allows
                    if run.settings.cross_validation:
                        # The cross-validation has judged laws already.
                        allows = refused(allows, [law.name for law in HYPOTHESES if run.takes(law)])
                    found = run.safely.run(checks.CAUSES, None, diagnose, of, shown, run.tried, allows)
            of_halves = (run, problem, fit, recipe, known)
            split = run.safely.run(checks.HALVES, checks.FAILED, self._split_half, *of_halves)
        known = checks.widened_by_split_half(known, split, latency_s, problem.latency_range_s)
        if settings.hold_first:
            known = _including(known, first.theta)
        for kinds, std in settings.common_std:
            known = _scaled_together(known, kinds, std)
        facts: dict[str, Any] = {}
        if local is not None:
            with run.check(AFTER_FIT):
                of_step = (run.problem, local, known)
                known, step = run.safely.run(checks.PHYSICS_STEP, (known, {}), checks.with_step, *of_step)
                facts |= {"physics_step": step} if step else {}
        rows = laws.candidates()
        if found is not None and judged[1] is not None:
            known, facts["diagnosis"] = checks.with_causes(judged[0], judged[1], known, found.causes)
            # The cross-validation has judged laws already.
            rows += [row for row in found.candidates if row.explanation not in screened.gains]
        if rows:
            facts["candidates"] = [row.to_json() for row in ranked(rows)]
        pairs = confounded(problem, fit.normal.hessian / known.inflation)
        if laws.choices:
            known = known.with_alarms(*laws.findings(theta))
            facts["laws"] = laws.facts(theta)
        names = problem.channel_names
        facts |= {
            "cross_validation": laws.to_json(),
            "residual_std": dict(zip(names, map(float, first.scale), strict=True)),
            "prediction_rmse": dict(zip(names, map(float, fit.scale), strict=True)),
            "window_s": recipe.seconds,
            "noise_std": problem.noise_std[problem.channels].tolist(),
            "inflation": known.inflation,
            "at_bound": names_at_bound(problem.space, theta),
            "split_half": split.to_json(),
            "confounded": [dataclasses.asdict(pair) for pair in pairs],
        }
        if chi2 > MISMATCH_CHI2:
            seconds = settings.mismatch_s or settings.long_s
            kind = "fitted" if settings.mismatch_s else "smoothed"
            window = f" over {seconds:g} s from {kind} start states"
            known = known.with_alarms(last=[Unexplained.larger(chi2, window)])
        words = dict.fromkeys((*known.null_directions, *(pair.words for pair in pairs)))
        known = dataclasses.replace(known, null_directions=tuple(words))
        return FitOutcome(
            searched=searched,
            theta=theta,
            latency_s=latency_s,
            chi2=chi2,
            known=known,
            facts=facts,
            space=problem.space,
            latency_range_s=problem.latency_range_s,
        )

    def _searched(
        self, run: CalibrationRun, problem: Problem, first: OutputErrorFit, windows: Sequence[OutputErrorFit]
    ) -> CalibrationResult:
        """Return the search's result, or the model's own values where none is needed."""
        settings, reduced = self.settings, self._reduced(problem, first)
        if not settings.search_always:
            fits = [fit.member for fit in (first, *windows)]
            error = np.mean(np.log(prediction_rmse(problem, fits, settings.compared_s)), axis=1)
            if np.min(error) < np.mean(np.log(standing_rmse(problem, settings.compared_s))):
                return nominal().run(reduced, run.budget, run.rng)
        why = (
            "" if settings.search_always else "the fits predict no better than a robot that stands still, so "
        )
        run.say_search(why)
        return run.attempts.run(reduced, 0, run.budget, run.progress)

    def _reduced(self, problem: Problem, first: OutputErrorFit) -> Problem:
        """Return the search's problem: part of the recordings, and the first fit's residuals as scale."""
        std = first.expected_std if problem.known_std is None else problem.known_std
        return problem.on(self._spread(problem, SEARCH_S), std)

    def _spread(self, problem: Problem, seconds: float) -> list[SampledEpisode]:
        """Return stretches of the recordings, spread evenly over them, of this total length [s]."""
        parts = [p for e in problem.episodes for p in stretches(e, self.settings.stretch_s)]
        return spread([p for p in parts if p.usable.any()], seconds)

    def _choose(
        self,
        run: CalibrationRun,
        problem: Problem,
        seed: int,
        whole: Sequence[OutputErrorFit],
        laws: Sequence[LawCandidate],
        *,
        search: bool,
    ) -> LawfulChoice:
        """Fit every candidate without each fold and compare the predictions of that fold.

        Each fit of a fold continues from that of all recordings, ``whole``: the minimum is near, and a fit
        ends in it whatever its start. Without ``search``, that on all recordings was no better start, and no
        fold is searched. Fits with laws follow, as long as they predict better than all without.
        """
        from deal_hw.calib.data.folds import on_folds
        from deal_hw.calib.pipeline.law_choice import LawfulChoice

        settings, before = self.settings, problem.steps
        masks = _fold_masks(problem)
        # Sent to workers, so without the fits, which hold the recordings.
        fits = partial(
            dataclasses.replace(self, first=(), given=None)._of_fold,
            starts=[(fit.member, fit.recipe) for fit in whole],
            seed=seed,
            search=run.attempts.search if search else None,
            budget=run.budget,
        )
        errors = partial(_errors, seconds=settings.long_s)
        on = problem
        if search and problem.policy is not None:
            # A search may run the policy, whose network cannot be sent.
            on = problem.sharing(tasks=InThisProcess())
        say = partial(_say_fold, run, len(masks))
        found = on_folds(on, masks, fits, errors, "long", settings.long_s, say)
        decided = LawfulChoice(found) if found.note else self._with_laws(run, problem, laws, found)
        made = dataclasses.replace(decided.made, steps=problem.steps - before)
        return dataclasses.replace(decided, made=made)

    def _with_laws(
        self, run: CalibrationRun, problem: Problem, laws: Sequence[LawCandidate], without: Choice
    ) -> LawfulChoice:
        """Compare fits with laws in the folds with those of a choice without them."""
        from deal_hw.calib.pipeline.law_choice import LawfulChoice, law_errors

        masks, errors = _fold_masks(problem), partial(_errors, seconds=self.settings.long_s)
        gained = law_errors(problem, masks, laws, without, errors, partial(_say_fold, run, len(masks)))
        return LawfulChoice.of(without, laws, gained)

    def _of_fold(
        self,
        train: Problem,
        fold: int,
        starts: Sequence[tuple[Member, Recipe]],
        seed: int,
        search: CalibrationMethod[Problem] | None,
        budget: Budget,
    ) -> dict[str, Member]:
        """Return every candidate without a law from the data of a fold."""
        first, *windows = [
            fit_output_error(train, *start, recipe, iterations=FOLD_DERIVATIVES) for start, recipe in starts
        ]
        searched = None
        if search is not None:
            rng = np.random.default_rng([seed, fold])
            searched = search.run(self._reduced(train, first), budget, rng)
        return self._members(train, first, windows, searched)

    def _better_start(self, problem: Problem, first: OutputErrorFit, searched: CalibrationResult) -> bool:
        """Return whether the search's estimate predicts short windows better than the first fit."""
        both = [first.member, (searched.estimate, searched.latency_s)]
        error = np.mean(np.log(prediction_rmse(problem, both, self.settings.compared_s)), axis=1)
        return bool(error[1] < error[0])

    def _windows(self, run: CalibrationRun, problem: Problem, start: Member) -> list[OutputErrorFit]:
        """Return the fits over growing windows, from a start."""
        windows_s = self.settings.windows_s if run.settings.cross_validation else (self.settings.long_s,)
        recipe, found = self.settings.recipe("long"), list[OutputErrorFit]()
        for seconds in windows_s:
            fit = fit_beyond_ends(problem, start, dataclasses.replace(recipe, seconds=seconds))
            found.append(fit)
            problem, start = fit.plain.problem, fit.member
        return found

    def _members(
        self,
        problem: Problem,
        first: OutputErrorFit,
        windows: Sequence[OutputErrorFit],
        searched: CalibrationResult | None,
        only: str | None = None,
    ) -> dict[str, Member]:
        """Return the estimate of every candidate without a law, or of as many as ``only`` needs."""
        settings, found = self.settings, {"short": first.member}
        if searched is not None:
            found["search"] = searched.estimate, searched.latency_s
        found |= {f"{fit.recipe.seconds:g} s": fit.member for fit in windows[:-1]}
        found["long"] = windows[-1].member
        for name, recipe in settings.variants.items():
            if only in (None, name):
                theta, latency_s = found["long"]
                latency_s = latency_s if recipe.latency else problem.first_latency_s
                most = FOLD_DERIVATIVES if only is None else None
                found[name] = fit_output_error(problem, theta, latency_s, recipe, iterations=most).member
        return found

    def _split_half(
        self, run: CalibrationRun, problem: Problem, fit: OutputErrorFit, recipe: Recipe, known: Uncertainty
    ) -> SplitHalf:
        """Fit two halves of the motions from the estimate on all data, and compare."""
        from deal_hw.calib.data.folds import fold_masks
        from deal_hw.calib.validation.checks import HALVES, SplitHalf, agreement

        before, values = problem.steps, 1 + len(problem.space) / problem.independent
        # Derivatives by each value and the latency, each with its steps; central ones at the end.
        members = HALF_DERIVATIVES * (values + 1 + SECANTS) + 2 * values
        cost = float(members * fit.plain.seconds / problem.robot.step_s)
        if not run.allows(HALVES, cost):
            return SplitHalf(note=f"left out: it would take {cost:.1g} physics steps")
        parts = map(problem.part, fold_masks(problem, 2))
        try:
            halves = [
                fit_output_error(
                    part, fit.theta, fit.latency_s, recipe, iterations=HALF_DERIVATIVES, central=True
                )
                for part in parts
            ]
        except InsufficientDataError as err:
            return SplitHalf(note=f"a half cannot be fitted: {err}")
        both = [uncertainty_at(problem, half, own_scale=True) for half in halves]
        fits = [(h.theta, h.latency_s) for h in halves]
        searched = fit.latency_s if recipe.latency and problem.fixed_latency_s is None else None
        return agreement(known, fits, both, searched, problem.steps - before)


def default_method(search: CalibrationMethod[Problem], name: str = "default") -> CalibrationPipeline:
    """Return `default`: local fit, search, refinement, and far from the noise fits of predictions."""
    return CalibrationPipeline(search, name, fits=Refinement(predictions=BRIEF))


def output_error_method(
    search: CalibrationMethod[Problem], name: str = "output-error"
) -> CalibrationPipeline:
    """Return `output-error`: fits by cross-validation, after the local fit and a search."""
    return CalibrationPipeline(search, name, fits=OutputErrorFits())


def without_laws(search: CalibrationMethod[Problem], name: str) -> CalibrationPipeline:
    """Return `output-error-no-laws`: the same, with no law that the model lacks."""
    return CalibrationPipeline(search, name, Validation(laws=False), fits=OutputErrorFits())


def local() -> CalibrationPipeline:
    """Return `local`: only the fits over short and then long windows, from the nominal values.

    It suits a robust, damped motion and a model within a factor of about two. The fits take a twentieth of a
    search's time, the checks of the model about twice the fits'.
    """
    return CalibrationPipeline(nominal(), "local", Validation(cross_validation=False), fits=OutputErrorFits())


BRIEF = OutputErrorFits(
    OutputErrorSettings(
        windows_s=(0.15, 0.3), compared_s=0.15, mismatch_s=0.2, first=Recipe(seconds=0.1), search_always=False
    )
)
"""Fits of predictions of a robot whose joints are not all held by servos. A pole that falls forgets where it
was in some 0.3 s: the time constant of 0.5 m is 0.2 s. In less, friction shows little beside inertia."""

FORCES = ("servo_stiffness", "servo_damping", "dof_frictionloss")
"""Kinds of parameters that scale with all forces."""
GAIT = OutputErrorSettings(
    windows_s=(0.2,),
    compared_s=0.1,
    mismatch_s=0.0,
    first=Recipe(seconds=0.1, robust=True, iterations=12),
    robust=True,
    fitted_s=9.0,
    stretch_s=1.5,
    hold_first=True,
    search_always=False,
    common_std=((FORCES, 0.05), (("geom_friction",), 0.065)),
)
"""Half a step of the gait, and a quarter. In shorter windows, errors of the start states dominate. In longer
ones most feet land or slide. No motion on feet separates forces from the mass, which the motors' efforts are
assumed to give to 5 %. The floor's friction was off by 6.5 % rms on five emulated robots (``realistic``,
tuning seeds 0 to 4), also with fits from the true start states."""


def gait() -> CalibrationPipeline:
    """Return `gait`: short, robust fits of a walking robot, from the nominal values.

    Start states are smoothed, not fitted: fitted ones would explain each landing of a foot. Where these fits
    explain nothing, the adversarial search looks for another start.
    """
    # Here, as it loads torch, which the other pipelines of this file need only for that search.
    from deal_hw.calib.search.deal import Deal

    settings = Validation(local_first=False, cross_validation=False)
    return CalibrationPipeline(Deal(), "gait", settings, fits=OutputErrorFits(GAIT))


def _scaled_together(known: Uncertainty, kinds: Container[str], std: float) -> Uncertainty:
    """Add a common relative error ``std`` of all parameters of these kinds to what is known."""
    space, at = known.space, known.space.to_scale(known.theta)
    factor = np.array([1.0 + std * (p.kind in kinds) for p in space])
    along = space.to_scale(known.theta * factor) - at
    covariance = known.covariance + np.outer(along, along)
    ends = space.to_scale(known.interval.T)
    sides = np.sign(ends - at) * np.hypot(ends - at, Z90 * along)
    interval = np.stack(list(space.from_scale(at + sides)), axis=1)
    return dataclasses.replace(known.with_covariance(covariance), interval=interval)


def _including(known: Uncertainty, other: FloatArray) -> Uncertainty:
    """Widen intervals and covariance to include another estimate, (K,)."""
    apart = known.space.to_scale(other) - known.space.to_scale(known.theta)
    low, high = known.interval.T
    covariance = known.covariance + np.outer(apart, apart)
    interval = np.stack([np.minimum(low, other), np.maximum(high, other)], axis=1)
    return dataclasses.replace(known.with_covariance(covariance), interval=interval)


def _fold_masks(problem: Problem) -> Sequence[Sequence[Mask]]:
    """Return the samples of each recording that each fold leaves out; a single motion is split in time."""
    from deal_hw.calib.data.folds import fold_masks, motion_numbers, time_masks

    motions = motion_numbers(problem.episodes)[-1] + 1
    return time_masks(problem, FOLDS) if motions == 1 else fold_masks(problem, min(motions, FOLDS))


def _say_fold(run: CalibrationRun, folds: int, fold: int, law: str = "") -> None:
    question = f"does {law} predict it better?" if law else "which fit predicts unseen data best?"
    run.say("cross-validation", f"{fold + 1} of {folds}: {question}")


def _joined_stretches(problem: Problem) -> Problem:
    """Return the problem with consecutive stretches joined, so that long windows fit."""
    episodes = joined(problem.episodes)
    return problem.on(episodes, problem.known_std) if len(episodes) < len(problem.episodes) else problem


def _errors(test: Problem, members: Sequence[Member], seconds: float) -> FloatArray:
    """Return the errors of the members' predictions over a time [s], (N,)."""
    rmse = prediction_rmse(test, members, seconds)
    return np.array([_error(test, of_channels) for of_channels in rmse])


def _error(problem: Problem, rmse: FloatArray) -> float:
    """Return the mean error of the channels, (M,); the geometric mean where units differ."""
    if len(set(problem.channel_units)) == 1:
        return float(np.mean(rmse))
    return float(np.exp(np.mean(np.log(rmse))))
