"""Ranges that nobody chose grow where the recordings ask for it.

The usual range of a parameter is a factor around the model's value. It is a guess, and a model may be further
off: on a real cart-pole the model's motor was too weak by a factor of 12. So is that of the latency: a filter
of a drive adds to a delay, and both can be later than any delay alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping

import numpy as np

from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.intervals import latency_end, pressed_ends, wider_latency
from deal_hw.calib.fit.output_error import OutputErrorFit, Recipe, fit_output_error
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.pipeline.calibration_run import CalibrationRun, FitOutcome
from deal_hw.calib.pipeline.minima import clearly_lower
from deal_hw.calibration import BEFORE_SEARCH, LATENCY, listed
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import wider

MOST = 2
"""Most times that a range grows: a factor of 125 for most kinds, 4 for the latency. Beyond it the model is
wrong."""

Again = Callable[[Problem, Refined], Refined | None]
"""Returns the fit with wider ranges, from that with narrower ones; None where none is better."""


def pressed(problem: Problem, fit: Refined) -> dict[str, int]:
    """Return the guessed ranges that the data press, by parameter: -1 at the lower end, 1 at the higher."""
    # Where a narrow range leaves a large residual, it hides what else the recordings show: that is no reason.
    K, slope = len(problem.space), fit.normal.gradient
    ends = pressed_ends(problem.space, fit.theta, slope[:K])
    sides = dict(zip(problem.space.names, map(int, ends), strict=True))
    if (end := latency_end(problem, fit.latency_s, problem.latency_range_s)) and end * slope[K] <= 0:
        sides[LATENCY] = end
    return {name: side for name, side in sides.items() if side and name in problem.guessed}


def grown_ranges(
    before: Problem, after: ParameterSpace, latency_range_s: tuple[float, float]
) -> dict[str, list[float]]:
    """Return the ranges that have grown, by parameter, and that of the latency [s]: plain JSON values."""
    ends = {p.name: [p.low, p.high] for p in after}
    grown = {p.name: ends[p.name] for p in before.space if ends[p.name] != [p.low, p.high]}
    return grown if latency_range_s == before.latency_range_s else grown | {LATENCY: list(latency_range_s)}


def _wider(problem: Problem, sides: Mapping[str, int]) -> Problem:
    """Return the problem with ranges that go on at these ends, by parameter."""
    found = problem.with_space(wider(problem.space, {n: side for n, side in sides.items() if n != LATENCY}))
    if LATENCY not in sides:
        return found
    return found.sharing(latency_range_s=wider_latency(problem.latency_range_s, sides[LATENCY]))


def with_wider_ranges(run: CalibrationRun, fit: Refined, again: Again) -> tuple[CalibrationRun, Refined]:
    """Return the run and its fit with wider ranges, where these leave clearly less residual.

    Args:
        run: The calibration.
        fit: A fit to its recordings.
        again: Fits with wider ranges.
    """
    given = run.problem
    for _ in range(MOST):
        if not (sides := pressed(run.problem, fit)):
            break
        problem = _wider(run.problem, sides)
        if not grown_ranges(run.problem, problem.space, problem.latency_range_s):
            break
        found = again(problem, fit)
        if found is None:
            break
        # Longer windows are fitted only where shorter ones are explained.
        longer = found.shooting.length > fit.shooting.length
        if not (longer or clearly_lower(found, fit)):
            break
        run, fit = dataclasses.replace(run, problem=problem), found
    if grown := grown_ranges(given, run.problem.space, run.problem.latency_range_s):
        ranges = [f"{name} {_text(given, name, *ends)}" for name, ends in grown.items()]
        run.say(
            BEFORE_SEARCH,
            "the recordings press against the ends of usual ranges, and beyond them the fit is better. New "
            f"ranges: {listed(ranges)}. If such values are impossible, give a range ({_options(grown)})",
        )
    return run, fit


def fit_beyond_ends(problem: Problem, start: Member, recipe: Recipe) -> OutputErrorFit:
    """Fit from a start; where it ends at an end of a range that nobody chose, again in a wider one.

    Only parameters whose expected value holds them go on there. Nothing else would end such a fit, since its
    residual scale says that the model is wrong.
    """
    fit = fit_output_error(problem, *start, recipe)
    for _ in range(MOST):
        space = problem.space
        # Whatever the slope: the expected value holds it beyond the end.
        ends = pressed_ends(space, fit.theta, np.zeros(len(space)))
        at_end = {
            p.name: int(end)
            for p, end in zip(space, ends, strict=True)
            if end and p.prior_std is not None and p.name in problem.guessed
        }
        wide = wider(space, at_end)
        if not grown_ranges(problem, wide, problem.latency_range_s):
            break
        problem = problem.with_space(wide)
        fit = fit_output_error(problem, *fit.member, recipe)
    return fit


def _text(problem: Problem, name: str, low: float, high: float) -> str:
    """Return a range of a parameter, or of the latency, with its unit."""
    units = {p.name: p.unit for p in problem.space} | {LATENCY: "s"}
    return f"{low:.3g} to {high:.3g} {units[name]}".rstrip()


def _options(names: Collection[str]) -> str:
    """Return the options that give the ranges of parameters, and of the latency."""
    options = ["--latency-range LOW HIGH"] if LATENCY in names else []
    return ", ".join(options + (["--range NAME LOW HIGH"] if len(names) > len(options) else []))


def with_doubted_recordings(
    run: CalibrationRun, given: Problem, narrow: Refined | None, found: FitOutcome
) -> FitOutcome:
    """Return a fit that explains the recordings, with an alarm if these may be wrong instead.

    Values beyond the usual ranges can make up for a wrong clock or unit. Where undoing such an error explains
    the recordings in the usual ranges, both explanations are named.

    Args:
        run: The calibration.
        given: Its problem with the usual ranges.
        narrow: The fit in them; None where simulations diverged.
        found: The fit that explains the recordings.
    """
    grown = grown_ranges(given, run.problem.space, run.problem.latency_range_s)
    if not (grown and run.settings.diagnosis):
        return found
    usual = dataclasses.replace(run, problem=given, local=narrow, shared=[])
    checked = usual.shared_error()
    if (suspect := checked.found) is None:
        run.note_untried(checked)
        return found
    # A law or a zero that the fit has is no value of the model.
    space = found.space or run.problem.space
    values = dict(zip(space.names, map(float, found.theta), strict=True)) | {LATENCY: found.latency_s}
    ranges = {p.name: (p.low, p.high) for p in given.space} | {LATENCY: given.latency_range_s}
    beyond = [f"{name} = {values[name]:.3g} (usual: {_text(given, name, *ranges[name])})" for name in grown]
    alarm = dataclasses.replace(
        suspect.alarm,
        means=f"Or they are right, and these values are beyond their usual ranges: {listed(beyond)}. "
        "The recordings do not tell which.",
        do=f"{suspect.alarm.do} If they are right, give the ranges yourself ({_options(grown)}).",
    )
    run.say(BEFORE_SEARCH, str(alarm))
    rows = [suspect.candidate.to_json(), *found.facts.get("candidates", ())]
    return found.with_alarms(alarm, shared_error=suspect.to_json(), candidates=rows)
