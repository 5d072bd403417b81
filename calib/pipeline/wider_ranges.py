"""Ranges that nobody chose grow where the recordings ask for it.

The usual range of a parameter is a factor around the model's value. It is a guess, and a model may be further
off: on a real cart-pole the model's motor was too weak by a factor of 12.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import pressed_ends
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.minima import clearly_lower
from deal_hw.calibration import BEFORE_SEARCH, listed
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.parameters import wider

MOST = 2
"""Most times that a range grows: a factor of 125 for most kinds. Beyond it the model is wrong."""

Again = Callable[[Problem, Refined], Refined | None]
"""Returns the fit with wider ranges, from that with narrower ones; None where none is better."""


def pressed(problem: Problem, fit: Refined) -> dict[str, int]:
    """Return the guessed ranges that the data press, by parameter: -1 at the lower end, 1 at the higher."""
    # Where a narrow range leaves a large residual, it hides what else the recordings show: that is no reason.
    ends = pressed_ends(problem.space, fit.theta, fit.normal.gradient[: len(problem.space)])
    sides = dict(zip(problem.space.names, map(int, ends), strict=True))
    return {name: side for name, side in sides.items() if side and name in problem.guessed}


def grown_ranges(before: ParameterSpace, after: ParameterSpace) -> dict[str, list[float]]:
    """Return the ranges that have grown, by parameter: plain JSON values."""
    ends = {p.name: [p.low, p.high] for p in after}
    return {p.name: ends[p.name] for p in before if ends[p.name] != [p.low, p.high]}


def with_wider_ranges(run: CalibrationRun, fit: Refined, again: Again) -> tuple[CalibrationRun, Refined]:
    """Return the run and its fit with wider ranges, where these leave clearly less residual.

    Args:
        run: The calibration.
        fit: A fit to its recordings.
        again: Fits with wider ranges.
    """
    given = run.problem.space
    for _ in range(MOST):
        space = wider(run.problem.space, pressed(run.problem, fit))
        if not grown_ranges(run.problem.space, space):
            break
        problem = run.problem.with_space(space)
        found = again(problem, fit)
        if found is None:
            break
        # Longer windows are fitted only where shorter ones are explained.
        longer = found.shooting.length > fit.shooting.length
        if not (longer or clearly_lower(found, fit)):
            break
        run, fit = dataclasses.replace(run, problem=problem), found
    if grown := grown_ranges(given, run.problem.space):
        ranges = listed(
            [
                f"{name} {low:.3g} to {high:.3g} {given[name].unit}".rstrip()
                for name, (low, high) in grown.items()
            ]
        )
        run.say(
            BEFORE_SEARCH,
            "the recordings press against the ends of usual ranges, and beyond them the fit is better. New "
            f"ranges: {ranges}. If such values are impossible, give a range (--range NAME LOW HIGH)",
        )
    return run, fit
