"""State that the stages of one calibration share, what they cost, and the result of a fitting strategy."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import BEFORE_SEARCH, Budget, CalibrationResult, Progress, ProgressCallback
from deal_hw.findings import Finding, SafeChecks
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

if TYPE_CHECKING:
    from deal_hw.calib.fit.intervals import Uncertainty
    from deal_hw.calib.fit.output_error import OutputErrorFit
    from deal_hw.calib.fit.refinement import Refined
    from deal_hw.calib.hypotheses.candidates import Candidate
    from deal_hw.calib.hypotheses.cause_words import Diagnosis
    from deal_hw.calib.hypotheses.hypothesis import Hypothesis
    from deal_hw.calib.hypotheses.random_delay import DelaysAsked
    from deal_hw.calib.hypotheses.shared_errors import SharedErrorCheck
    from deal_hw.calib.hypotheses.trials import Tried

SHARED_ERRORS = "errors that commands and measurements share"
EXPLANATIONS = "laws that the model lacks"
OWN_ZEROS = "zeros of each recording"
AFTER_FIT = "after the fit"
"""Names of checks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOutcome:
    """Result of a fitting strategy.

    Attributes:
        searched: Result of the search, or its substitute.
        theta: The estimate, (K,).
        latency_s: Its latency [s].
        chi2: Mean squared residual over the noise variance.
        known: Uncertainty of the estimate.
        facts: More entries for the provenance: plain JSON values.
        space: Parameters of the estimate, where fits may have more of them than the search, whose population
            is then left out; None: the search's.
        latency_range_s: Range of the latency's fit [s]; None: the problem's.
    """

    searched: CalibrationResult
    theta: FloatArray
    latency_s: float
    chi2: float
    known: Uncertainty
    facts: Mapping[str, Any] = field(default_factory=dict)
    space: ParameterSpace | None = None
    latency_range_s: tuple[float, float] | None = None

    def with_alarms(
        self, *first: Finding, last: Sequence[Finding] = (), chi2: float | None = None, **facts: Any
    ) -> FitOutcome:
        """Return it with more alarms, before and after its own, and with more facts."""
        chi2 = self.chi2 if chi2 is None else chi2
        known = self.known.with_alarms(*first, last=last)
        return dataclasses.replace(self, chi2=chi2, known=known, facts={**self.facts, **facts})

    def with_cause(self, cause: Diagnosis, row: Candidate) -> FitOutcome:
        """Return it with a cause that it has allowed for, before its own, and with its row of the table."""
        causes, rows = self.facts.get("diagnosis", []), self.facts.get("candidates", [])
        return self.with_alarms(
            cause, diagnosis=[cause.to_json(), *causes], candidates=[row.to_json(), *rows]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRun:
    """State shared by the stages of one calibration.

    Attributes:
        problem: Recordings and simulator.
        budget: Limits of the searches.
        rng: The only source of randomness.
        attempts: Runs the search on all recordings and stores its results.
        settings: Which checks to run.
        local: The local fit, if there is one.
        tried: Laws that the model may lack, which were tried.
        progress: Receives progress reports.
        first_steps: Physics steps of the problem before this calibration.
        checks: Physics steps of each check so far, by its name.
        left_out: Why checks were left out, by their names.
        safely: Runs checks after the fit, and notes those that fail.
        inexact: Names of laws whose exact fit to all recordings left more than noise.
        shared: What was found of errors that commands and measurements share, once it was looked for.
        delays: Fits with random delays of commands so far, beside the fits that they began from.
    """

    problem: Problem
    budget: Budget
    rng: np.random.Generator
    attempts: Restarts
    settings: Validation
    local: Refined | None = None
    tried: tuple[Tried, ...] = ()
    progress: ProgressCallback | None = None
    first_steps: int = 0
    checks: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    safely: SafeChecks = field(default_factory=SafeChecks)
    inexact: set[str] = field(default_factory=set)
    shared: list[SharedErrorCheck] = field(default_factory=list)
    delays: list[tuple[Refined, DelaysAsked]] = field(default_factory=list)
    _begun: list[int] = field(default_factory=list)

    @contextlib.contextmanager
    def check(self, name: str) -> Iterator[None]:
        """Count what runs inside as a check."""
        before = self.problem.steps
        self._begun.append(before)
        try:
            yield
        finally:
            self._begun.pop()
            self.checks[name] = self.checks.get(name, 0) + self.problem.steps - before

    @property
    def check_steps(self) -> int:
        """Physics steps of the checks so far, with the one that is running."""
        running = self.problem.steps - self._begun[0] if self._begun else 0
        return sum(self.checks.values()) + running

    @property
    def fit_steps(self) -> int:
        """Physics steps of the fits so far, also of searches that an earlier process has finished."""
        return self.problem.steps - self.first_steps + self.attempts.earlier_steps - self.check_steps

    @property
    def check_steps_left(self) -> int:
        """Physics steps that checks may take: together no more than the fits."""
        return self.fit_steps - self.check_steps

    @property
    def search_steps(self) -> int:
        """Physics steps of a search to its budget's end, at one a device period."""
        return self.budget.population * self.budget.generations * sum(e.steps for e in self.problem.episodes)

    def allows(self, name: str, steps: float) -> bool:
        """Return whether a check that takes at most so many steps fits in; one that does not is noted."""
        if self.settings.thorough or steps <= self.check_steps_left:
            return True
        self.left_out[name] = "left out, since the checks would take longer than the fits"
        return False

    def may_try(self, name: str, steps: float) -> bool:
        """Return whether a law may be tried before a search, which a fit with it may make needless."""
        if self.settings.thorough or steps <= self.check_steps_left + self.search_steps:
            return True
        self.left_out[name] = "left out, since it would take longer than the fits"
        return False

    def shared_error(self) -> SharedErrorCheck:
        """Return what was found of errors that commands and measurements share; it is looked for once."""
        from deal_hw.calib.hypotheses.shared_errors import find_shared_error

        if not self.shared:
            # A wrong recording is worse than a law that is missing, so the laws that were tried take none of
            # these steps. The search that follows is a part of the fits.
            most = math.inf if self.settings.thorough else self.fit_steps + self.search_steps
            with self.check(SHARED_ERRORS):
                tell = partial(self.say, SHARED_ERRORS, "")
                self.shared.append(find_shared_error(self.problem, self.local, tell, most))
        return self.shared[0]

    def random_delays(self, fit: Refined) -> DelaysAsked:
        """Return what a fit says of random delays of commands; each fit is asked once."""
        from deal_hw.calib.hypotheses.random_delay import fit_delays

        for before, found in self.delays:
            same = before.shooting.problem is fit.shooting.problem
            if same and before.chi2 == fit.chi2 and np.array_equal(before.theta, fit.theta):
                return found
        self.delays.append((fit, fit_delays(self.problem, fit, EVIDENCE)))
        return self.delays[-1][1]

    def note_untried(self, checked: SharedErrorCheck) -> None:
        """Note the shared errors for which no steps were left."""
        if checked.found is None and checked.tried < checked.of:
            left = f"{checked.of - checked.tried} of {checked.of} corrections were not tried"
            self.left_out[SHARED_ERRORS] = f"{left}: they would take longer than the fits"

    def say(self, stage: str, message: str = "", done: int = 0, total: int = 1, **candidate: Any) -> None:
        """Report a stage that begins, how far it is, or, as fields of `Progress`, a candidate estimate."""
        if self.progress is not None:
            self.progress(Progress(stage, done, total, message, **candidate))

    def takes(self, hypothesis: Hypothesis) -> bool:
        """Return whether the result may have a hypothesis: without laws, what an MJCF can say."""
        return self.settings.laws or hypothesis.in_mjcf

    def ask(self, law: str) -> None:
        """Report that a law is tried."""
        self.say(EXPLANATIONS, f"does {law} predict motion that it was not fitted to?")

    def say_search(self, why: str = "") -> None:
        """Report that the search begins, of which kind, and why; nothing where it stands in for none."""
        search = self.attempts.search
        if not search.moves:
            return
        kind = "an adversarial search" if search.adversarial else "a search"
        if self.local is not None:
            why = "the local fit leaves more than noise, so "
        self.say(BEFORE_SEARCH, f"{why}{kind} follows ({search.name})")

    def offer(
        self,
        stage: str,
        found: Refined | OutputErrorFit | CalibrationResult,
        done: int = 1,
        total: int = 1,
        source: str = "",
    ) -> None:
        """Report a candidate estimate, the stage that found it, how far that is, and from where it began."""
        theta = found.estimate if isinstance(found, CalibrationResult) else found.theta
        candidate: dict[str, Any] = {"estimate": theta, "latency_s": found.latency_s}
        candidate |= {"values": {"chi2": found.chi2}, "space": self.problem.space}
        self.say(stage, f"{source}chi2 {found.chi2:.3g}", done, total, **candidate)

    def offer_fitted(
        self, space: ParameterSpace, fit: Refined | OutputErrorFit, chi2: float, known: Uncertainty
    ) -> None:
        """Report the fit that the result will have, with its uncertainty, before the checks."""
        fitted = CalibrationResult(
            method="last fit",
            space=space,
            estimate=fit.theta,
            interval=known.interval,
            covariance=known.covariance,
            verdicts=known.verdicts,
            null_directions=known.null_directions,
            prior_directions=known.prior_directions,
            latency_s=fit.latency_s,
            latency_interval_s=known.latency_interval_s,
            chi2=chi2,
            alarms=known.alarms,
            biased=known.biased,
        )
        self.say(AFTER_FIT, f"chi2 {chi2:.3g}", fitted=fitted)
