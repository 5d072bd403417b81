"""Names commands that a log has one row after the one in which they were sent.

The robot then moves before its command, which no latency explains: the fit holds it at zero and bends other
values, mostly the damping. A fit with the commands one sample earlier shows it.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deal_hw.calibration import EXPLAINED_CHI2, CalibrationResult
from deal_hw.findings import Finding

if TYPE_CHECKING:
    from deal_hw.calib.data.problem import Problem
    from deal_hw.sim.recordings.episode import SampledEpisode

BETTER: Final = 0.5
"""Share of chi2 that is left with earlier commands, at most, to name them [-]. Another cause of a residual at
zero latency gains less from commands that come too early."""
AT_ZERO: Final = 0.5
"""A latency of less is at zero [samples]."""


def late_commands(problem: Problem, result: CalibrationResult) -> tuple[Finding, ...]:
    """Return an alarm if commands one sample earlier explain the recordings clearly better.

    It is tried only where the latency ended at zero and the residual is above the noise.

    Args:
        problem: The problem.
        result: Its result.
    """
    if problem.rates > 1:
        # A row is another time in each recording.
        return ()
    period_s = problem.period_s
    searched = problem.fixed_latency_s is None and not problem.noise_free and problem.robot.base is None
    if not searched or result.latency_s > AT_ZERO * period_s or result.chi2 <= EXPLAINED_CHI2:
        return ()
    from deal_hw.calib.fit.refinement import refine

    moved = problem.sharing(episodes=tuple(map(_earlier, problem.episodes)))
    fits = [refine(of, problem.space.nominal, 0.0).chi2 for of in (problem, moved)]
    if not fits[1] < BETTER * min(fits[0], result.chi2):
        return ()
    before, after = (float(np.sqrt(chi2)) for chi2 in (min(fits[0], result.chi2), fits[1]))
    return (
        Finding.alarm(
            f"The motion begins one row before its command: with the commands {period_s * 1e3:.3g} ms "
            f"earlier the error falls from {before:.2g} to {after:.2g} times the sensor's noise.",
            "The log has each command in the row after the one in which it was sent; the dampings are wrong.",
            f"Write command_shift_s: {-period_s:.6g} into the column map (--columns), which moves the "
            "commands, and calibrate again.",
        ),
    )


def _earlier(episode: SampledEpisode) -> SampledEpisode:
    """Return a recording with its commands one sample earlier; the last one holds."""
    periods = round(float(np.median(np.diff(episode.sample))))
    sent: dict[str, Any] = {
        name: np.concatenate([values[periods:], np.repeat(values[-1:], min(periods, len(values)), axis=0)])
        for name in ("target", "stiffness", "damping", "effort_limit", "speed_limit")
        if len(values := getattr(episode, name))
    }
    return dataclasses.replace(episode, **sent)
