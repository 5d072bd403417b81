"""The end of a calibration: what a fit's residual is allowed for, its uncertainty, and checks.

A residual of least squares may show delays of single commands, laws on top of them, and random errors of the
model. The fit that allows for them takes its place. Alarms and causes still speak of the residual itself.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import LEAST_JITTER_S, WHITE_SAMPLES, Uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined, refined_at
from deal_hw.calib.fit.residual import value_bounds
from deal_hw.calib.fit.weak_directions import scale_direction
from deal_hw.calib.pipeline.calibration_run import AFTER_FIT, CalibrationRun, FitOutcome
from deal_hw.calibration import Budget, CalibrationResult

if TYPE_CHECKING:
    from deal_hw.calib.hypotheses.random_delay import DelaysAsked
    from deal_hw.calib.hypotheses.random_errors import ErrorFit
    from deal_hw.calib.pipeline.laws_on_delays import LawsOnDelays

# What follows a fit is imported where it is used: until the first fit nothing of it is loaded.


def conclude_fit(
    run: CalibrationRun,
    searched: CalibrationResult | None,
    refined: Refined,
    restarts: int = 0,
    *,
    wrong: bool = False,
    late: LawsOnDelays | None = None,
) -> FitOutcome:
    """Allow for what the residual shows, scan the latency, estimate the uncertainty, and check the result.

    ``searched`` is the search's result; None where the fit needed no search. With ``wrong`` the model does
    not explain the recordings, although the residual is as large as the weights say. ``late`` is the fit with
    random delays of commands, and laws on top, where that is known already.
    """
    from deal_hw.calib.validation.checks import doubtful, hold_windows, judge, unexplained
    from deal_hw.calib.validation.time_steps import averaged, scan_latency

    allowed = _allowed(run, searched, refined, wrong, late)
    run, problem, fit, plain = allowed.run, allowed.problem, allowed.fit, allowed.plain
    searched = searched or without_search(run.problem, run.budget, plain)
    scan, whole = None, None
    # A fit that noise does not explain cannot tell whether delays vary.
    doubt = allowed.late is not None or wrong or doubtful(plain)
    if problem.fixed_latency_s is None and not doubt and allowed.delays_are_whole:
        scan = scan_latency(problem, fit, run.progress)
        # Whole ticks that have not converged decide nothing: the free latency is kept.
        whole = scan if scan is not None and scan.decides(fit) else None
    if whole is not None:
        fit = plain = whole.refined[whole.best]
    decided = whole is not None or problem.fixed_latency_s is not None
    fit = settled(with_rows(fit))
    known = uncertainty_at(problem, fit, fixed_latency=decided)
    if whole is not None:
        known = averaged(problem, whole, known)
    known = allowed.widened(known, fit, decided)
    run.offer_fitted(problem.space, fit, plain.chi2, known)
    with run.check(AFTER_FIT):
        judged = fit if allowed.errors is None else plain
        known, checked = judge(
            problem, fit, known, run.settings, run.tried, run.allows, plain=judged, safely=run.safely
        )
    if doubt or unexplained(plain):
        # Delays were found because the fit with a constant one is not right.
        known = hold_windows(known, fit.latency_s, allowed.before)
    facts: dict[str, Any] = {
        "restarts": restarts,
        "window_s": fit.shooting.length * problem.period_s,
        "noise_std": problem.noise.position_std.tolist(),
        "timing_std_s": problem.noise.timing_std_s,
        "refinement_iterations": fit.iterations,
        **checked,
    }
    if scan is not None:
        facts["latency_scan"] = {
            "ticks": list(scan.ticks),
            "chi2": [p.chi2 for p in scan.refined],
            "weights": scan.weights.tolist(),
        }
    return allowed.said(
        FitOutcome(
            searched=searched,
            theta=fit.theta,
            latency_s=fit.latency_s,
            chi2=plain.chi2,
            known=known,
            facts=facts,
            space=problem.space,
            latency_range_s=problem.latency_range_s,
        )
    )


def settled(fit: Refined) -> Refined:
    """Return a fit, which has linearised residuals, with the common scale of masses and forces as expected.

    Only what was expected holds that scale. The refinement's derivatives are off by kinks of dry friction,
    which held it where the first steps had left it. Motion, and its derivatives by logarithms, are the same
    at any scale; where something that is known holds it, there is no such step.
    """
    shooting, point, normal = fit.shooting, fit.point, fit.normal
    scale = scale_direction(shooting)
    curvature = float(scale @ normal.hessian @ scale)
    expected = float(scale**2 @ normal.prior)
    if shooting.contacts or not expected > 0.5 * curvature:
        return fit
    low, high = value_bounds(shooting.problem)
    step = -float(scale @ normal.gradient) / curvature * scale
    value = np.clip(point.value + step, np.minimum(low, point.value), np.maximum(high, point.value))
    moved = dataclasses.replace(point, value=value)
    cost = shooting.cost(moved)
    if not cost < normal.cost:
        return fit
    there = dataclasses.replace(
        normal, cost=cost, gradient=normal.gradient + normal.hessian @ (value - point.value)
    )
    known = refined_at(shooting, moved, there, fit.iterations)
    return dataclasses.replace(known, shorter=fit.shorter, refused=fit.refused)


@dataclass(frozen=True, slots=True)
class _Allowed:
    """A fit with what its residual is allowed for.

    Attributes:
        run: The calibration, with the laws that were taken.
        problem: The problem of the fit.
        fit: The fit.
        plain: The same without random errors: that of least squares, or with delays.
        before: The fit of least squares.
        asked: What the residual says of delays; None where it was not asked.
        late: The fit with delays of single commands.
        errors: The fit with random errors.
    """

    run: CalibrationRun
    problem: Problem
    fit: Refined
    plain: Refined
    before: Refined
    asked: DelaysAsked | None = None
    late: LawsOnDelays | None = None
    errors: ErrorFit | None = None

    @property
    def delays_are_whole(self) -> bool:
        """Whether the latency may be a whole number of ticks: the mean of delays that vary is none."""
        return self.errors is None and not _jitters(self.run)

    def widened(self, known: Uncertainty, fit: Refined, decided: bool) -> Uncertainty:
        """Return the uncertainty of the fit, which may have a given latency now, with all that moves it."""
        if self.late is not None:
            return self.late.late.widened(known, fit.latency_s)
        if self.errors is not None:
            return self.errors.widened(known, fit.latency_s)
        return known if self.asked is None else self.asked.widened(known, fit, decided)

    def said(self, outcome: FitOutcome) -> FitOutcome:
        """Return the result with delays, laws and random errors among its alarms and candidates."""
        from deal_hw.calib.hypotheses.candidates import Candidate

        if self.errors is not None:
            shares = self.errors.errors.shares
            taken = Candidate.of_errors(self.errors.gain, shares.values())
            rows = [taken.to_json(), *outcome.facts.get("candidates", [])]
            return outcome.with_alarms(random_errors=shares, candidates=rows)
        if self.late is None:
            return outcome
        cause = self.late.late.cause(outcome.latency_s)
        row = Candidate.of("a delay of its own for each command", "likelihood", cause, "taken")
        outcome = outcome.with_cause(cause, row)
        return self.late.said(outcome)


def _jitters(run: CalibrationRun) -> bool:
    """Return whether the times of the samples jitter, and so may those of commands."""
    return run.problem.noise.timing_std_s >= LEAST_JITTER_S


def _allowed(
    run: CalibrationRun,
    searched: CalibrationResult | None,
    refined: Refined,
    wrong: bool,
    late: LawsOnDelays | None,
) -> _Allowed:
    """Return the fit that allows for what the residual of another one shows; see :func:`conclude_fit`."""
    from deal_hw.calib.hypotheses.random_errors import fit_errors
    from deal_hw.calib.pipeline.laws_on_delays import laws_on_delays
    from deal_hw.calib.validation.checks import unexplained

    found = _Allowed(run, run.problem, refined, refined, refined)
    if late is None and (_jitters(run) or unexplained(refined, WHITE_SAMPLES)):
        asked = run.random_delays(refined)
        found = dataclasses.replace(found, asked=asked)
        if asked.found is not None:
            late = laws_on_delays(run, asked.found, run.may_try if searched is None else run.allows)
    if late is not None:
        # Random errors on top of delays and laws were no better on seven tuning robots.
        fit = late.late.fit
        return _Allowed(late.run, late.late.problem, fit, fit, late.late.before, late=late)
    if found.asked is None or not found.asked.correlated or wrong:
        return found
    run.say("fit", "the residual is correlated; a fit that allows for random errors")
    errors = fit_errors(found.plain)
    return found if errors is None else dataclasses.replace(found, fit=errors.fit, errors=errors)


def without_search(problem: Problem, budget: Budget, local: Refined) -> CalibrationResult:
    """Return the local fit in place of a search's result."""
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
