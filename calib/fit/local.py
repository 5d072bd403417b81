"""The first answer: the model's own values, refined without any search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import SETTINGS as REFINEMENT
from deal_hw.calib.fit.refinement import Polished, polish
from deal_hw.calibration import Progress, ProgressCallback
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSettings:
    """Settings of :func:`local_fit`.

    Attributes:
        seconds: It finds its way on so much of the recordings [s].
        hopeless: Shortest windows whose chi2 stays above this are not explained by longer fits either.
    """

    seconds: float = 8.0
    hopeless: float = 4.0


SETTINGS = LocalSettings()


def local_fit(problem: Problem, progress: ProgressCallback | None) -> Polished | None:
    """Refine the model's own values; return None where they are too far to be refined.

    Costs a small part of a search. Where its residual is explained by the sensors' noise nothing is left to
    search for. A part of the recordings says where the fit goes; all of them are fitted only where that part
    can be explained.
    """
    fixed = problem.fixed_latency_s is not None
    latency_s = problem.first_latency_s

    def notify(done: int, chi2: float) -> None:
        if progress is not None:
            words = f"from the model's own values: chi2 {chi2:.3g}"
            progress(Progress("local fit", done, done, words, values={"chi2": chi2}))

    def fit(part: Problem, theta: FloatArray, latency_s: float, stages_s: Sequence[float] | None) -> Polished:
        return polish(
            part, theta, latency_s, stages_s, fixed_latency=fixed, notify=notify, shake=problem.exact
        )

    part, nominal = _spread(problem, SETTINGS.seconds), problem.space.nominal
    if part is problem or problem.exact:
        found = fit(problem, nominal, latency_s, None)
        return found if np.isfinite(found.chi2) else None
    stages_s = REFINEMENT.contact_stages_s if problem.robot.base is not None else REFINEMENT.stages_s
    short, *longer = stages_s
    found = fit(part, nominal, latency_s, (short,))
    if not found.chi2 < SETTINGS.hopeless:
        return found if np.isfinite(found.chi2) else None
    try:
        return fit(problem, found.theta, found.latency_s, longer)
    except InsufficientDataError:
        # No recording holds a longer window.
        return fit(problem, found.theta, found.latency_s, (short,))


def _spread(problem: Problem, seconds: float) -> Problem:
    """Return the problem with pieces of a second, evenly spread, that add up to about so many seconds."""
    lengths = [len(e.sample) for e in problem.episodes]
    period_s = problem.episodes[0].period_s
    piece = max(round(1.0 / period_s), 1)
    every = max(math.floor(sum(lengths) * period_s / seconds), 1)
    number = np.arange(sum(lengths)) // piece
    kept = np.split(number % every == 0, np.cumsum(lengths)[:-1])
    return problem.part(kept) if every > 1 else problem
