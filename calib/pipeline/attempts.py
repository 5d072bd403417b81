"""What the residual of a local fit may come from, asked in order of cost until only noise is left.

Each attempt makes one kind of explanation a fit: another minimum, a finer physics step, zeros of encoders,
sensors that are finer than the model, laws, delays of single commands. It is taken where only noise is left
then. What remains unexplained is left to a search; see :mod:`deal_hw.calib.pipeline.stages`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

from deal_hw.calib.fit.intervals import FALSE_ALARMS, MISMATCH_CHI2, WHITE_SAMPLES, with_rows
from deal_hw.calib.fit.refinement import LOCAL_HOPELESS, Refined, refine
from deal_hw.calib.fit.unexplained import Unexplained
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2
from deal_hw.calib.pipeline.calibration_run import EXPLANATIONS, CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.pipeline.minima import RESTARTS, conclusive, lower_minimum, refined_from
from deal_hw.calib.pipeline.own_zeros import with_own_zeros
from deal_hw.calibration import BEFORE_SEARCH, CalibrationResult

if TYPE_CHECKING:
    from deal_hw.calib.hypotheses.trials import Explained

# What follows a fit is imported where it is used: until the first fit nothing of it is loaded.

Attempt: TypeAlias = Callable[[CalibrationRun, Refined], FitOutcome | CalibrationRun]
"""Asks a run and its local fit for one kind of explanation. Returns the outcome with it where only noise is
left then, otherwise the run with what it has learned."""


def first_outcome(run: CalibrationRun, attempts: Sequence[Attempt]) -> FitOutcome | CalibrationRun:
    """Return the outcome of the first attempt that has one; otherwise the run with what all have learned.

    Without a local fit there is nothing to explain.
    """
    for each in attempts:
        if run.local is None:
            break
        found = each(run, run.local)
        if isinstance(found, FitOutcome):
            return found
        run = found
    return run


def as_it_is(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask whether the fit leaves only noise, whose samples do not depend on each other."""
    return conclude_fit(run, None, local) if conclusive(run.problem, local, WHITE_SAMPLES) else run


def another_minimum(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for another minimum, where the residual is as small as noise, but has a pattern."""
    if not conclusive(run.problem, local):
        return run
    local = lower_minimum(run, local, RESTARTS) or local
    run = dataclasses.replace(run, local=local)
    return conclude_fit(run, None, local) if conclusive(run.problem, local) else run


def with_finer_step(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for a finer physics step.

    The error of a step is correlated, as that of a wrong model, and fine encoders show it. Where half the
    step explains a part of the residual, fits with it come before a search.
    """
    from deal_hw.calib.validation.time_steps import HALVINGS, check_step, halved

    problem, fit = run.problem, local
    if problem.noise_free or not local.chi2 < LOCAL_HOPELESS:
        return run
    for _ in range(HALVINGS):
        step = check_step(problem, with_rows(fit))
        # Residuals grow with the step, so half of it removes three quarters of what it adds to chi2.
        if not step.coarse or fit.chi2 * (1 - 4 / 3 * step.share) > MISMATCH_CHI2:
            break
        problem = halved(problem)
        window_s = fit.shooting.length * problem.period_s
        states = fit.shooting.states(fit.point)
        fit = refine(problem, fit.theta, fit.latency_s, (window_s,), states=states)
    if problem is run.problem or not conclusive(problem, fit):
        return run
    run.offer("local fit", fit)
    run.say(
        BEFORE_SEARCH,
        "the error of the model's physics step shows in these recordings: with "
        f"{1e3 * problem.robot.step_s:.3g} ms only noise is left, and the fit uses that step",
    )
    found = conclude_fit(dataclasses.replace(run, problem=problem, local=fit), None, fit)
    return found.with_alarms(fit_step_s=problem.robot.step_s)


def with_weights(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for sensors that are finer than the model; the chi2 is relative to their noise."""
    from deal_hw.calib.fit.channel_weights import weight_channels

    if (weighted := weight_channels(run.problem, local)) is None:
        return run
    names = weighted.problem.channel_names
    scale = dict(zip(names, map(float, weighted.scale), strict=True))
    words = ", ".join(f"{name} {value:.2g}" for name, value in scale.items() if value > 1)
    run.say(
        BEFORE_SEARCH,
        "these sensors are finer than the model; the fit weights them by the model's residual "
        f"(multiples of their noise): {words}",
    )
    found = conclude_fit(dataclasses.replace(run, problem=weighted.problem), None, weighted.fit, wrong=True)
    return found.with_alarms(
        last=[Unexplained.larger(weighted.chi2)], chi2=weighted.chi2, channel_weights=scale
    )


def with_limits(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for effort limits and dampings that are not searched, where drives reach their limits.

    Each robot has them, so no law is asked where they leave only noise.
    """
    from deal_hw.calib.hypotheses.trials import try_limits

    with run.check(EXPLANATIONS):
        tried = try_limits(run.problem, run.may_try, run.ask)
    return with_explanation(dataclasses.replace(run, tried=tried)) or run


def with_laws(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for laws that the model lacks, quantities that are 0 in it, and other masses.

    Around a poor fit only play and what is 0 are fitted; see `try_hypotheses`.
    """
    from deal_hw.calib.hypotheses.trials import try_hypotheses

    if run.settings.diagnosis:
        with run.check(EXPLANATIONS):
            tried = try_hypotheses(run.problem, with_rows(local), run.may_try, say=run.ask)
        run = dataclasses.replace(run, tried=tried)
    return with_explanation(run) or run


def with_explanation(run: CalibrationRun, searched: CalibrationResult | None = None) -> FitOutcome | None:
    """Return the fit with a law that the model lacks, if only noise is left then; otherwise None.

    No search follows: nothing but noise is left to explain. ``searched`` is the result of an earlier one.
    """
    from deal_hw.calib.hypotheses.candidates import law_candidates, ranked
    from deal_hw.calib.hypotheses.trials import explained, rivals
    from deal_hw.calib.validation.checks import hold_alike

    tried = [one for one in run.tried if run.takes(one.hypothesis)]
    if run.local is None or not tried:
        return None
    with run.check(EXPLANATIONS):
        found = explained(run.problem, run.local, tried)
    if not found or not found[0].explains:
        return None
    if searched is None and found[0].diagnosis.code == "mass" and run.shared_error().found is not None:
        # A clock that runs fast looks like a light link, too, and is the worse fault: that comes first.
        return None
    exact: list[tuple[Explained, Refined, CalibrationRun]] = []
    for one in rivals([one for one in found if one.explains]):
        name, wide = one.hypothesis.name, dataclasses.replace(run, problem=one.problem, progress=None)
        run.say("fit", f"{name} on all recordings")
        fit = refined_from(wide, one.theta, one.latency_s)
        if conclusive(one.problem, fit):
            exact.append((dataclasses.replace(one, theta=fit.theta, latency_s=fit.latency_s), fit, wide))
        else:
            run.inexact.add(name)
    if not exact:
        return None
    # The model's own values are somebody's best guess, so of those that explain alike the nearest is taken.
    (best, fit, wide), *others = sorted(exact, key=lambda each: each[0].change)
    names = [one.hypothesis.name for one, *_ in others]
    alarm = dataclasses.replace(best.diagnosis, do=best.hypothesis.taken_as(best.added, names))
    run.say(BEFORE_SEARCH, str(alarm))
    rows = law_candidates(run.tried, found, best.hypothesis.name, names)
    outcome = conclude_fit(dataclasses.replace(wide, progress=run.progress), searched, fit)
    if others:
        shifts = [best.shift_to(one) for one, *_ in others]
        known, added = hold_alike(best.problem, outcome.known, outcome.latency_s, shifts)
        outcome = dataclasses.replace(outcome, known=known).with_alarms(alike_std=added)
    return outcome.with_alarms(
        *([] if best.hypothesis.certain else [alarm]),
        diagnosis=[
            one.diagnosis.to_json()
            for one in (best, *(one for one, *_ in others))
            if not one.hypothesis.certain
        ],
        candidates=[row.to_json() for row in ranked(rows)],
    )


def with_random_delays(run: CalibrationRun, local: Refined) -> FitOutcome | CalibrationRun:
    """Ask for delays of single commands, and laws on top of them.

    Far from the noise delays seem to explain what no parameters there do. A wrong clock is the worse fault.
    """
    from deal_hw.calib.pipeline.laws_on_delays import laws_on_delays

    if local.chi2 > FAR_CHI2:
        return run
    run.say("fit", "does each command act after a delay of its own?")
    if (delays := run.random_delays(local).found) is None:
        return run
    found = laws_on_delays(run, delays, run.may_try)
    # What delays leave is asked as the alarm asks: no search makes a residual smaller that is noise.
    noise_left = conclusive(found.late.problem, found.late.fit, chance=FALSE_ALARMS)
    if not noise_left or run.shared_error().found is not None:
        return run
    return conclude_fit(run, None, local, late=found)


MODEL_HOLDS: Sequence[Attempt] = (as_it_is, another_minimum, with_finer_step, with_limits, with_own_zeros)
"""Attempts after which the model is right."""

MODEL_LACKS: Sequence[Attempt] = (with_laws, with_random_delays)
"""Attempts at what the model lacks. They make fits to parts of the recordings first."""
