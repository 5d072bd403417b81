"""The whole calibration: checks, a local fit, a search where that is not enough, uncertainty, validation.

:class:`CalibrationPipeline` is the same for simulated and real robots, with a fixed or a floating base. A
:class:`Fits` strategy continues where the local fit does not explain the recordings. :class:`Refinement`
searches and refines down to the sensors' noise.
:class:`deal_hw.calib.pipeline.output_error_fits.OutputErrorFits` fits predictions of a robot that no model
explains.
"""

from __future__ import annotations

import abc
import dataclasses
import time
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, WHITE_SAMPLES, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import (
    Refined,
    local_fit,
)
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2
from deal_hw.calib.pipeline.attempts import (
    MODEL_HOLDS,
    MODEL_LACKS,
    first_outcome,
    with_explanation,
    with_weights,
)
from deal_hw.calib.pipeline.calibration_run import (
    EXPLANATIONS,
    CalibrationRun,
    FitOutcome,
)
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.pipeline.minima import (
    ONE_SEARCH,
    RESTARTS,
    RestartSettings,
    better,
    gains_on_part,
    refined_from,
    refined_search,
)
from deal_hw.calib.pipeline.wider_ranges import grown_ranges, with_doubted_recordings, with_wider_ranges
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import (
    BEFORE_SEARCH,
    EXPLAINED_CHI2,
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)

# What follows a fit is imported where it is used: until the first fit nothing of it is loaded.


class Fits(abc.ABC):
    """Strategy where the local fit is not enough: searches, candidate fits, and the choice among them."""

    def started(self, run: CalibrationRun) -> Fits:
        """Report the strategy's fits from the nominal values, and return the strategy that continues them.

        They come before everything that takes long. There are none by default.
        """
        return self

    @abc.abstractmethod
    def best(self, run: CalibrationRun) -> FitOutcome:
        """Search, fit, choose, and estimate the uncertainty."""


class FitsOfPredictions(Protocol):
    """Fits that continue where a refinement ended."""

    def continued(self, run: CalibrationRun, searched: CalibrationResult, refined: Refined) -> FitOutcome:
        """Return the fit that predicts best, after a search's result and its refinement."""


DIVERGED = (
    "simulations diverge at the model's own values, so the search begins without them; check those values, "
    "or shorten the physics step (--physics-step)"
)


class CalibrationPipeline(CalibrationMethod[Problem]):
    """A calibration in stages; cheap stages come first.

    Args:
        search: The search.
        name: Name of the method; the search's by default.
        settings: Which checks to run, and whether the local fit comes first.
        fits: What follows where the local fit is not enough; :class:`Refinement` by default.
    """

    def __init__(
        self,
        search: CalibrationMethod[Problem],
        name: str | None = None,
        settings: Validation | None = None,
        *,
        fits: Fits | None = None,
    ) -> None:
        self.search, self.name = search, name or search.name
        self.settings = settings or Validation()
        self.fits = fits or Refinement()

    def run(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Calibrate. See :meth:`CalibrationMethod.run`.

        A resumed run reads finished searches from the checkpoint. It repeats the rest with the same result.
        """
        began, steps = time.perf_counter(), problem.steps
        check_excitation(problem)
        attempts = Restarts(self.search, rng, checkpoint)
        run = CalibrationRun(
            problem=problem,
            budget=budget,
            rng=rng,
            attempts=attempts,
            settings=self.settings,
            progress=progress,
            first_steps=steps,
        )
        offer = partial(run.offer, "local fit")
        local = local_fit(problem, offer) if self.settings.local_first else None
        if local is None and self.settings.local_first:
            run.say(BEFORE_SEARCH, DIVERGED)
        given, narrow = problem, local
        if local is not None:
            run, local = with_wider_ranges(run, local, lambda of, fit: local_fit(of, offer, fit))
        run = dataclasses.replace(run, local=local)
        found = first_outcome(run, MODEL_HOLDS)
        if isinstance(found, FitOutcome):
            found = with_doubted_recordings(run, given, narrow, found)
        else:
            found = first_outcome(found, [with_weights])
        if isinstance(found, CalibrationRun):
            fits = self.fits.started(found)
            if found.local is not None and progress is not None:
                local = with_rows(found.local)
                report_unidentifiable(found.problem, local, progress)
                found = dataclasses.replace(found, local=local)
            found = first_outcome(found, MODEL_LACKS)
            if isinstance(found, CalibrationRun):
                found = with_shared_error(fits, found)
        searched, known = found.searched, found.known
        # The search's own interval does not hold for the refined estimate.
        provenance = {k: v for k, v in searched.provenance.items() if k != "interval"} | {
            "search": searched.method,
            "search_seconds": searched.seconds,
            "search_estimate": dict(zip(searched.space.names, map(float, searched.estimate), strict=True)),
            "search_latency_s": searched.latency_s,
            **found.facts,
            "physics_steps": {"fits": run.fit_steps, **run.checks},
        }
        latency_range_s = found.latency_range_s or given.latency_range_s
        if grown := grown_ranges(given, found.space or searched.space, latency_range_s):
            provenance["grown_ranges"] = grown
        if run.left_out:
            provenance["checks_left_out"] = dict(run.left_out)
        # A fit that explains the recordings needs no sound critic before it.
        doubtful = searched.provenance.get("critic_diverged") and found.chi2 > EXPLAINED_CHI2
        of_search = searched.alarms[:1] if doubtful else ()
        result = dataclasses.replace(
            searched,
            method=self.name,
            space=found.space or searched.space,
            population=None if len(found.theta) > len(searched.space) else searched.population,
            estimate=found.theta,
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=known.null_directions,
            prior_directions=known.prior_directions,
            latency_s=found.latency_s,
            latency_interval_s=known.latency_interval_s,
            chi2=found.chi2,
            alarms=(*known.alarms, *of_search),
            biased=known.biased,
            steps=problem.steps - steps + attempts.earlier_steps,
            seconds=time.perf_counter() - began + attempts.earlier_seconds,
            provenance=provenance,
        )
        return result.with_failed(run.safely)


@dataclass(frozen=True)
class Refinement(Fits):
    """A search and its refinement; where the residual is unexplained, also drawn points, then other searches.

    The first search is short: a few generations find the basin, and the refinement finds its minimum with
    fewer simulations. If no refinement from a drawn point ends lower, the model is wrong, and nothing else is
    searched. Later searches use the whole budget, except for a floating base: there, long windows with
    contacts carry little information.

    Attributes:
        restarts: When drawn points and other searches follow.
        predictions: What follows where no values explain the recordings; None: the refinement is the result.
    """

    restarts: RestartSettings = RESTARTS
    predictions: FitsOfPredictions | None = None

    def best(self, run: CalibrationRun) -> FitOutcome:
        """Search and refine. See :meth:`Fits.best`."""
        settings, left, floating = self.restarts, run.budget.generations, run.problem.robot.base is not None
        if self.predictions is not None and run.local is not None and far_from_noise(run, run.local):
            # Fits of predictions follow, and no minimum is right: two starts that agree are enough.
            settings = dataclasses.replace(settings, alike_ends=True)
        best: tuple[CalibrationResult, Refined] | None = None
        run.say_search()
        attempt = 0
        for attempt in range(1 + settings.restarts):
            budget = dataclasses.replace(run.budget, generations=left, brief=attempt == 0 or floating)
            searched = run.attempts.run(run.problem, attempt, budget, run.progress)
            run.offer("search", searched)
            left -= len(searched.trace)
            if attempt == 0:
                refined, same = refined_search(run, searched, settings)
            else:
                refined, same = refined_from(run, searched.estimate, searched.latency_s), False
            # Two searches with the same unexplained residual say this, too.
            previous = best[1].chi2 if best is not None else np.inf
            same = same or abs(refined.chi2 - previous) < settings.same * previous
            if best is None or better(refined, best[1], settings):
                best = (searched, refined)
            if best[1].chi2 < settings.explained or same or left < settings.fewest_generations:
                break
        if best is None:
            raise RuntimeError("unreachable: at least one search is run")
        local, (searched, refined) = run.local, best
        if local is not None and local.chi2 < refined.chi2:
            # Short windows are easier to explain, so a shorter one is no evidence.
            if local.shooting.length >= refined.shooting.length:
                refined = local
        run, refined = with_wider_ranges(run, refined, partial(_refined_again, run))
        if self.predictions is not None and far_from_noise(run, refined):
            run.say("fit", "no values explain the recordings, so fits of predictions follow, and the best")
            return self.predictions.continued(run, searched, refined)
        again = with_laws_tried(run, refined)
        found = None if again is run else with_explanation(again, searched)
        return found or conclude_fit(again, searched, refined, attempt)


def with_laws_tried(run: CalibrationRun, refined: Refined) -> CalibrationRun:
    """Return the run with the refinement in place of the local fit, and laws that were tried around it.

    The local fit may be in another minimum, around which other laws gain.
    """
    from deal_hw.calib.hypotheses.trials import applicable, of_masses, try_hypotheses
    from deal_hw.calib.validation.checks import unexplained

    takes = run.settings.laws or of_masses(run.problem) or any(e.in_mjcf for e in applicable(run.problem))
    if not (run.settings.diagnosis and takes and unexplained(refined)):
        return run
    if run.local is not None and np.array_equal(run.local.theta, refined.theta):
        return run
    refined = with_rows(refined)
    with run.check(EXPLANATIONS):
        tried = try_hypotheses(run.problem, refined, run.allows, say=run.ask)
    return dataclasses.replace(run, local=refined, tried=tried)


def far_from_noise(run: CalibrationRun, refined: Refined) -> bool:
    """Return whether a residual is so large that fitted start states only hide how a model is wrong.

    Where folds over the motions are asked for, the fit that predicts best is then better than the one that
    explains most. A free base has its own windows (`gait`), and a given residual scale its own meaning.
    """
    problem = run.problem
    known = problem.known_std is not None or problem.noise_free
    return (
        run.settings.cross_validation and refined.chi2 > FAR_CHI2 and problem.robot.base is None and not known
    )


def _refined_again(run: CalibrationRun, problem: Problem, fit: Refined) -> Refined | None:
    """Refine a fit in wider ranges; None where they gain nothing in a part of long recordings."""
    if not gains_on_part(run, problem, fit):
        return None
    return refined_from(dataclasses.replace(run, problem=problem), fit.theta, fit.latency_s)


def best_of(fits: Fits, run: CalibrationRun) -> FitOutcome:
    """Return a strategy's result, or the local fit with random delays, where that explains more.

    Far from the noise delays would explain what no parameters there do.
    """
    from deal_hw.calib.pipeline.laws_on_delays import laws_on_delays

    found, local = fits.best(run), run.local
    if not run.settings.diagnosis or local is None or local.chi2 > FAR_CHI2:
        return found
    late = run.random_delays(local).found
    if late is None or not found.chi2 > max(late.fit.chi2, MISMATCH_CHI2):
        return found
    return conclude_fit(run, found.searched, local, late=laws_on_delays(run, late, run.allows))


def with_shared_error(fits: Fits, run: CalibrationRun) -> FitOutcome:
    """Return a strategy's result, with an alarm if commands and measurements share an error.

    The suspicion is reported before the search. Its correction leaves only noise, so no parameters are likely
    to be right, and a brief search has to find a simulator that predicts as well as the corrected recordings.
    If it does, the recordings are right: the suspicion is withdrawn, and the whole strategy follows.
    """
    from deal_hw.calib.validation.checks import unexplained

    local = run.local
    asked = run.settings.diagnosis and run.settings.local_first
    if not asked or (local is not None and not unexplained(local, WHITE_SAMPLES)):
        return best_of(fits, run)
    checked = run.shared_error()
    suspect = checked.found
    if suspect is None:
        run.note_untried(checked)
        return best_of(fits, run)
    run.say(BEFORE_SEARCH, str(suspect.alarm))
    unchecked = Validation(split_half=False, physics_step=False, diagnosis=False)
    found = Refinement(ONE_SEARCH).best(dataclasses.replace(run, settings=unchecked))
    if suspect.confirmed(found.theta, found.latency_s):
        rows = [suspect.candidate.to_json()]
        return found.with_alarms(suspect.alarm, shared_error=suspect.to_json(), candidates=rows)
    run.say(BEFORE_SEARCH, suspect.withdrawn)
    return best_of(fits, run)


def report_unidentifiable(problem: Problem, local: Refined, progress: ProgressCallback) -> None:
    """Report before the search which parameters the recordings do not show (Fisher information at ``local``).

    The local fit has linearised residuals.
    """
    # Model error does not reduce the information in the motion: only noise counts.
    noise_only = dataclasses.replace(local, chi2=1.0)
    known = uncertainty_at(problem, noise_only)
    blind = [n for n, v in zip(problem.space.names, known.verdicts, strict=True) if v == "not identifiable"]
    words = list(known.null_directions)
    if blind and not words:
        words = [", ".join(blind)]
    if words:
        progress(Progress(BEFORE_SEARCH, 1, 1, f"the data do not determine: {'; '.join(words)}"))
