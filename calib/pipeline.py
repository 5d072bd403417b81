"""The whole calibration: checks, a local fit, a search where that is not the answer, uncertainty, validation.

Two ways go on where the local fit does not explain the recordings. :class:`PolishedMethod` searches and
refines down to the sensors' noise; :mod:`deal_hw.calib.open_loop` fits predictions of a robot that no model
explains. Both end in an :class:`Outcome`, from which the result is made here.
"""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished, at_parameters, local_fit, polish, polish_robust
from deal_hw.calib.fit.solver import ROBUST, kurtosis
from deal_hw.calib.search.restarts import Attempts
from deal_hw.calib.uncertainty.intervals import MISMATCH, Uncertainty, statement, with_rows
from deal_hw.calib.uncertainty.time_steps import averaged, scan_latency
from deal_hw.calib.validation.cross_validation import Choice, choose
from deal_hw.calib.validation.verdict import Validation, judge, unexplained
from deal_hw.calibration import (
    BEFORE_SEARCH,
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartSettings:
    """When a search is run again from other draws.

    Attributes:
        restarts: Most searches after the first.
        same: Two searches whose unexplained chi2 differ by a smaller share say that the model is wrong, not
            the search.
        fewest_generations: With fewer left in the budget another search would not get anywhere.
        explained: Below this chi2 no other search is run.
    """

    restarts: int = 2
    same: float = 0.2
    fewest_generations: int = 15
    explained: float = MISMATCH.chi2


RESTARTS = RestartSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What a way of fitting ended with.

    Attributes:
        searched: What the search found, or what stands for it.
        theta: The estimate, (K,).
        latency_s: Its latency [s].
        chi2: Mean squared residual over the noise's.
        known: What is known there.
        null_directions: Combinations that the data cannot tell, in words.
        facts: What else the provenance says: plain JSON values.
        other_steps: Physics steps that were simulated for it by other problems than the given one.
    """

    searched: CalibrationResult
    theta: FloatArray
    latency_s: float
    chi2: float
    known: Uncertainty
    null_directions: tuple[str, ...]
    facts: Mapping[str, Any] = field(default_factory=dict)
    other_steps: int = 0


class Calibration(CalibrationMethod[Problem]):
    """A calibration in stages, ordered by what they cost.

    Args:
        search: The search.
        name: Name of the whole.
        settings: What is checked, and whether the local fit comes first.
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
        """Calibrate. See :meth:`CalibrationMethod.run`.

        A resumed run takes finished searches from the checkpoint; the rest is done again, to the same
        numbers.
        """
        began, steps = time.perf_counter(), problem.steps
        check_excitation(problem)
        local = local_fit(problem, progress) if self.settings.local_first else None
        if local is not None:
            offer("local fit", local.theta, local.latency_s, local.chi2, progress)
        earlier_steps, earlier_seconds = 0, 0.0
        if local is not None and conclusive(problem, local):
            found = to_the_noise(
                problem, without_search(problem, budget, local), local, self.settings, progress
            )
        else:
            if local is not None and progress is not None:
                local = with_rows(local)
                foretell(problem, local, progress)
            attempts = Attempts(self.search, rng, checkpoint)
            found = self.fitted(problem, budget, rng, attempts, local, progress)
            earlier_steps, earlier_seconds = attempts.earlier_steps, attempts.earlier_seconds
        searched, known = found.searched, found.known
        # What the search says of its own interval does not hold for these.
        provenance = {k: v for k, v in searched.provenance.items() if k != "interval"} | {
            "search": searched.method,
            "search_seconds": searched.seconds,
            "search_estimate": dict(zip(problem.space.names, map(float, searched.estimate), strict=True)),
            "search_latency_s": searched.latency_s,
            **found.facts,
        }
        return dataclasses.replace(
            searched,
            method=self.name,
            estimate=found.theta,
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=found.null_directions,
            latency_s=found.latency_s,
            latency_interval_s=known.latency_interval_s,
            chi2=found.chi2,
            alarms=known.alarms,
            steps=problem.steps - steps + found.other_steps + earlier_steps,
            seconds=time.perf_counter() - began + earlier_seconds,
            provenance=provenance,
        )

    @abc.abstractmethod
    def fitted(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        attempts: Attempts,
        local: Polished | None,
        progress: ProgressCallback | None,
    ) -> Outcome:
        """Search and fit where the local fit is not the answer.

        Args:
            problem: Recordings and simulator.
            budget: What the searches may use.
            rng: The only source of randomness.
            attempts: Runs the searches.
            local: The local fit, where there is one.
            progress: Called now and then.
        """


class PolishedMethod(Calibration):
    """A search followed by the polish; searched again from other draws while the residual is unexplained.

    Args:
        search: The search.
        name: Name of the whole.
        settings: What is checked, and whether the local fit comes first.
        restarts: When it is searched again.
    """

    def __init__(
        self,
        search: CalibrationMethod[Problem],
        name: str | None = None,
        settings: Validation | None = None,
        restarts: RestartSettings = RESTARTS,
    ) -> None:
        super().__init__(search, name, settings)
        self.restarts = restarts

    def fitted(
        self,
        problem: Problem,
        budget: Budget,
        rng: np.random.Generator,
        attempts: Attempts,
        local: Polished | None,
        progress: ProgressCallback | None,
    ) -> Outcome:
        """Search, polish, let inner folds say whether the polish helps. See :meth:`Calibration.fitted`."""
        searched, polished, restarts = _until_explained(attempts, problem, budget, self.restarts, progress)
        choice = self._choose(problem, budget, rng, searched, polished, progress)
        return to_the_noise(problem, searched, polished, self.settings, progress, choice, restarts)

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
        robust = self.settings.robust and kurtosis(polished.normal.residual) > ROBUST.heavy_tails
        # Drawn after all searches, so that a resumed run draws the same.
        seed = int(rng.integers(2**32))
        length = polished.shooting.length
        # A fold needs no more generations than the whole did.
        less = dataclasses.replace(
            budget, generations=max(len(searched.trace), self.restarts.fewest_generations)
        )
        return choose(problem, self.search, less, seed, length, searched.steps, robust)


def to_the_noise(
    problem: Problem,
    searched: CalibrationResult,
    polished: Polished,
    settings: Validation,
    progress: ProgressCallback | None,
    choice: Choice | None = None,
    restarts: int = 0,
) -> Outcome:
    """Scan the latency, say what is known, check it.

    Args:
        problem: Recordings and simulator.
        searched: What the search found, or what stands for it.
        polished: Where the fit ended.
        settings: Which checks.
        progress: Called while the latency is scanned.
        choice: What cross-validation said.
        restarts: Searches after the first.
    """
    scan = None
    if choice is not None and choice.chosen == "search":
        length, states = polished.shooting.length, polished.shooting.states(polished.point)
        polished = at_parameters(problem, searched.estimate, searched.latency_s, length, states)
    elif problem.fixed_latency_s is None:
        scan = scan_latency(problem, polished, progress)
    whole = scan is not None and scan.decides(polished)
    if scan is not None and whole:
        polished = scan.polished[scan.best]
    decided = whole or problem.fixed_latency_s is not None
    if choice is not None and choice.chosen == "robust polish":
        polished = polish_robust(polished, decided)
    polished = with_rows(polished)
    known = statement(problem, polished, fixed_latency=decided)
    if scan is not None and whole:
        known = averaged(problem, scan, known)
    known, checked = judge(problem, polished, known, settings)
    facts: dict[str, Any] = {
        "restarts": restarts,
        "window_s": polished.shooting.length * problem.episodes[0].period_s,
        "noise_std": problem.noise.position_std.tolist(),
        "timing_std_s": problem.noise.timing_std_s,
        "polish_iterations": polished.iterations,
        **checked,
    }
    if choice is not None:
        facts["folds"] = choice.to_json()
    if scan is not None:
        facts["latency_scan"] = {
            "ticks": list(scan.ticks),
            "chi2": [p.chi2 for p in scan.polished],
            "weights": scan.weights.tolist(),
        }
    return Outcome(
        searched=searched,
        theta=polished.theta,
        latency_s=polished.latency_s,
        chi2=polished.chi2,
        known=known,
        null_directions=known.null_directions,
        facts=facts,
    )


def offer(
    stage: str, theta: FloatArray, latency_s: float, chi2: float, progress: ProgressCallback | None
) -> None:
    """Report a fit that could be the answer.

    Args:
        stage: What found it.
        theta: Physical parameters, (K,).
        latency_s: Total latency [s].
        chi2: Mean squared residual over the noise's.
        progress: Who is told.
    """
    if progress is not None:
        progress(Progress(stage, 1, 1, estimate=theta, latency_s=latency_s, values={"chi2": chi2}))


def foretell(problem: Problem, local: Polished, progress: ProgressCallback) -> None:
    """Say before the search what the recordings cannot tell, by their Fisher information at the local fit.

    Args:
        problem: Recordings and simulator.
        local: The local fit, with linearised residuals.
        progress: Who is told.
    """
    # What the model does not explain says nothing of what the motion shows: noise alone counts.
    noise_only = dataclasses.replace(local, chi2=1.0)
    known = statement(problem, noise_only, fixed_latency=problem.fixed_latency_s is not None)
    blind = [n for n, v in zip(problem.space.names, known.verdicts, strict=True) if v == "not identifiable"]
    words = list(known.null_directions)
    if blind and not words:
        words = [f"nothing is seen of {', '.join(blind)}"]
    if words:
        progress(Progress(BEFORE_SEARCH, 1, 1, "; ".join(words)))


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
    attempts: Attempts,
    problem: Problem,
    budget: Budget,
    settings: RestartSettings,
    progress: ProgressCallback | None,
) -> tuple[CalibrationResult, Polished, int]:
    best: tuple[CalibrationResult, Polished] | None = None
    attempt, left = 0, budget.generations
    for attempt in range(1 + settings.restarts):
        searched = attempts.run(problem, attempt, dataclasses.replace(budget, generations=left), progress)
        offer("search", searched.estimate, searched.latency_s, searched.chi2, progress)
        left -= len(searched.trace)
        polished = polish_from(problem, searched, progress)
        offer("refinement", polished.theta, polished.latency_s, polished.chi2, progress)
        previous = best[1].chi2 if best is not None else np.inf
        if best is None or _better(polished, best[1]):
            best = (searched, polished)
        # Two searches that end at the same unexplained residual say that the model is wrong, not the search.
        same = abs(polished.chi2 - previous) < settings.same * previous
        if best[1].chi2 < settings.explained or same or left < settings.fewest_generations:
            break
    if best is None:
        raise RuntimeError("unreachable: at least one search is run")
    return (*best, attempt)


def _better(a: Polished, b: Polished) -> bool:
    """Say whether ``a`` explains more: a longer window only counts where both are explained."""
    if a.chi2 < MISMATCH.chi2 and b.chi2 < MISMATCH.chi2 and a.shooting.length != b.shooting.length:
        return a.shooting.length > b.shooting.length
    return a.chi2 < b.chi2


def polish_from(problem: Problem, searched: CalibrationResult, progress: ProgressCallback | None) -> Polished:
    """Polish a search's estimate."""
    fixed = problem.fixed_latency_s is not None
    latency = searched.latency_s if problem.fixed_latency_s is None else problem.fixed_latency_s

    def notify(done: int, chi2: float) -> None:
        if progress is not None:
            progress(Progress("polish", done, done, f"chi2 {chi2:.3g}", values={"chi2": chi2}))

    return polish(problem, searched.estimate, latency, fixed_latency=fixed, notify=notify)
