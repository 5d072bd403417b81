"""Test for a random delay of each command, on the residual of a fit.

Random delays predict no sample, but they predict where the residual is large: each pushes in proportion to
the change of its command. Any other model error looks like a random force of constant size, white or slow, or
like delays that change slowly: dry friction that falls with speed holds the motion back where commands turn
round, over many of them. All are Gaussian processes beside white noise. Random delays are found where the
residual is likelier with them than with forces alone, and slow ones are not likelier still by more than
chance: a robot can have both. Then the fit is repeated with a delay of its own for each command; see
:mod:`deal_hw.calib.fit.command_delays`.

Where they are not found, the residual may still be far likelier with these processes than as white noise.
Then the fit allows for them; see :mod:`deal_hw.calib.hypotheses.random_errors`. If white noise is as likely,
commands may jitter all the same where sample times do: intervals hold what the residual leaves possible.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import CommandDelays, Problem
from deal_hw.calib.fit.command_delays import (
    MOST_COMMANDS,
    FreeRows,
    LikelyStd,
    command_spacing_s,
    commands_of,
    delay_columns,
    free_rows,
    likely_std,
    moved_commands,
)
from deal_hw.calib.fit.intervals import LEAST_JITTER_S, MISMATCH_CHI2, Uncertainty, kinks_of
from deal_hw.calib.fit.refinement import STAGES_S, WORSE, Refined, refine
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.hypotheses.cause_words import Diagnosis
from deal_hw.calib.hypotheses.random_errors import (
    FORCES,
    ComparedErrors,
    LikelyErrors,
    SeenErrors,
    at_least,
)
from deal_hw.calib.hypotheses.thresholds import EVIDENCE, NEAR_CHI2
from deal_hw.calibration import Z90
from deal_hw.errors import InsufficientDataError
from deal_hw.findings import Finding
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

MOST_SPACED = 2.5
"""Largest standard deviation of delays, in times between commands [-]. Above a third of that time some
commands wait for those before them, so their delays are no longer independent. On pendulums at 200 Hz, with
0.6, 1.3 and 1.6 times that time, fits that took them as independent left a chi2 of 1.07, 1.00 and 1.00."""

SETTLED = 0.01
"""Share of the commands that may still move by a period when the rounds of one window length end [-]."""

ROUNDS = 3
"""Most fits of one window length, each around the delays of the one before."""

ITERATIONS = 6
"""Most iterations of each fit."""


class PossibleDelays(NamedTuple):
    """Delays of commands that a residual neither shows nor rules out.

    J are the derivatives of whitened residuals r by the fitted values; J^T r moves a fit.

    Attributes:
        std_s: Their standard deviation [s].
        white: Covariance of J^T r with white noise of unit variance, J^T J, (K + 1, K + 1).
        late: The same with delays of this size as well.
    """

    std_s: float
    white: FloatArray
    late: FloatArray

    @classmethod
    def of(cls, rows: Sequence[FreeRows], std_s: float) -> PossibleDelays:
        """Return delays of this standard deviation."""
        white = np.sum([np.einsum("wdi,wdj->ij", r.parameter, r.parameter) for r in rows], axis=0)
        along = [np.einsum("wdi,wdp->wpi", r.parameter, r.columns) for r in rows]
        late = np.sum([np.einsum("wpi,wpj->ij", each, each) for each in along], axis=0)
        return cls(std_s, white, white + std_s**2 * late)

    def ratio(self, belief: FloatArray) -> FloatArray:
        """Return the variance of each value over that with white noise, (K + 1,).

        ``belief`` is the prior information on the values, (K + 1,). Where it is infinite, a value is given.
        """
        # x = B J^T r with B = (J^T J + prior)^-1: the sandwich of White (1980), its middle from V.
        K = len(belief)
        found, free = np.ones(K), np.isfinite(belief)
        inside, prior = np.ix_(free, free), np.diag(belief[free])
        B = np.linalg.inv(self.white[inside] + prior)
        found[free] = np.diag(B @ (self.late[inside] + prior) @ B) / np.diag(B)
        return found


@dataclass(frozen=True, slots=True)
class RandomDelay:
    """How well random delays explain a residual.

    Attributes:
        deviance: Gain in deviance over white noise.
        gain: Gain in deviance over white noise and random forces, beside these; 0 where delays that change
            slowly are likelier, beyond chance.
        share: Share of the residual's variance.
        std_s: Standard deviation of the delays [s].
    """

    deviance: float
    gain: float
    share: float
    std_s: float


@dataclass(frozen=True, slots=True)
class DelayFit:
    """A fit that has a delay of its own for each command.

    Attributes:
        problem: The problem with these delays.
        fit: Its fit.
        found: How well random delays explained the residual of the fit before.
        before: That fit, with one constant delay.
    """

    problem: Problem
    fit: Refined
    found: RandomDelay
    before: Refined

    def cause(self, latency_s: float) -> Diagnosis:
        """Return the delays as a cause of the residual, which the fit has allowed for."""
        alarm = Finding.alarm(
            f"Each command acts after its own delay: {1e3 * latency_s:.3g} ms on average, with a standard "
            f"deviation of {1e3 * self.found.std_s:.2g} ms.",
            "The latency is their mean. Each command's own delay was an unknown of the fit, so the intervals "
            "include them.",
            "To measure more exactly: end other programs on the computer that sends, send at an even pace, "
            "or time-stamp commands where they are received.",
        )
        return Diagnosis.of("delay", self.found.share, self.found.deviance, (), alarm)

    def widened(self, known: Uncertainty, latency_s: float) -> Uncertainty:
        """Return an uncertainty that is at least that of the fit with one constant delay.

        Delays also take up a part of what else a model lacks, even where they leave nothing but noise. So
        they make no interval narrower. ``latency_s`` is the mean delay.
        """
        means = "Commands jitter, too: each has a delay of its own in the fit."
        return at_least(known, self.before, latency_s, means)


@dataclass(frozen=True, slots=True)
class DelaysAsked:
    """What a fit's residual says of random delays.

    Attributes:
        found: The fit with random delays; None where the residual does not show any.
        correlated: Without such a fit: whether the residual is no larger than the noise, but likelier with
            random errors of any kind than as white noise, beyond chance; see
            :func:`~deal_hw.calib.hypotheses.random_errors.fit_errors`.
        possible: Without such a fit: delays of commands that jitter as the sample times do, or as much as the
            residual leaves possible. None where sample times do not jitter, or nothing was asked.
    """

    found: DelayFit | None = None
    correlated: bool = False
    possible: PossibleDelays | None = None

    def widened(self, known: Uncertainty, refined: Refined, fixed_latency: bool) -> Uncertainty:
        """Return the uncertainty of a fit in which possible delays, if there are any, move the values."""
        if self.possible is None:
            return known
        problem = refined.shooting.problem
        known = known.with_jitter(problem.noise.timing_std_s, self._means(problem.noise.timing_std_s))
        flat = 12.0 / np.append(problem.space.width, np.ptp(problem.latency_range_s)) ** 2
        given = np.append((known.bound != 0) | known.blind, fixed_latency)
        ratio = self.possible.ratio(np.where(given, np.inf, flat + refined.normal.prior))
        free, std = ~given, np.zeros(len(flat))
        white = np.linalg.inv((refined.normal.hessian + np.diag(flat))[np.ix_(free, free)])
        std[free] = kinks_of(problem) * np.sqrt(ratio[free] * np.diag(white))
        std = np.minimum(std, flat**-0.5)
        wider = known.widened_to(std[:-1])
        if fixed_latency:
            return wider
        reach_s = max(Z90 * std[-1], known.latency_reach_s(refined.latency_s))
        return wider.latency_widened_to(reach_s, refined.latency_s, problem.latency_range_s)

    def _means(self, timing_std_s: float) -> str:
        """Return what the intervals have of commands that jitter, in words."""
        possible_s = self.possible.std_s if self.possible is not None else 0.0
        if possible_s >= timing_std_s:
            return "Commands may jitter as much: the intervals allow for that."
        return (
            f"The recordings leave room for commands that jitter by {1e3 * possible_s:.1g} ms: the intervals "
            "allow for that."
        )


def fit_delays(problem: Problem, refined: Refined, least: float) -> DelaysAsked:
    """Ask a fit for random delays of commands, and fit them where its residual shows any.

    Args:
        problem: The problem, with a constant delay.
        refined: Its fit.
        least: Least gain in deviance that shows them [-].
    """
    if problem.command_delays is not None or problem.noise_free or problem.robot.base is not None:
        return DelaysAsked()
    if problem.known_std is not None:
        # A chosen residual scale is no noise beside which delays could be seen.
        return DelaysAsked()
    still: tuple[dict[int, int], ...] = tuple({} for _ in problem.episodes)
    none = CommandDelays(0.0, refined.theta, refined.latency_s, still)
    asked = refined
    while (seen := SeenErrors.of(asked)) is None:
        # Its windows may hold too many commands, and those of the stage before it fewer.
        if asked.shorter is None:
            return DelaysAsked()
        asked = asked.shorter
    compared = ComparedErrors.of(seen) if seen.enough else None
    found = None if compared is None else _random_delay(compared)
    free = seen.free
    likely = _likely(asked, free)
    most_s = min(MOST_SPACED * command_spacing_s(problem), most_delay_std_s(problem))
    if found is not None and min(found.gain, likely.gain) > least and likely.std_s <= most_s:
        delays = _fitted(problem.with_command_delays(none), asked, found, likely.std_s)
        if delays is not None and delays.fit.chi2 <= NEAR_CHI2:
            return DelaysAsked(replace(delays, before=refined))
    # Shorter windows say less of the values, so no fit of them takes the place of one of longer ones. A
    # residual above the noise is an error of the model that is not random: on a real pendulum with a chi2 of
    # 3.6 a fit that took it for random predicted 1.8 times worse.
    small = asked is refined and refined.chi2 <= MISMATCH_CHI2
    correlated = small and compared is not None and LikelyErrors.of(compared).gain > EVIDENCE
    jitter_s = problem.noise.timing_std_s
    if jitter_s < LEAST_JITTER_S:
        return DelaysAsked(correlated=correlated)
    possible = PossibleDelays.of(free, min(jitter_s, likely.most_s))
    return DelaysAsked(correlated=correlated, possible=possible)


def _fitted(problem: Problem, asked: Refined, found: RandomDelay, std_s: float) -> DelayFit | None:
    """Return the fit with random delays of this standard deviation [s]; None where it cannot be made.

    ``asked`` is the fit of the problem with delays of 0.
    """
    delayed = _with(problem, asked, std_s)
    best: Refined | None = None
    fit = asked
    for seconds in STAGES_S:
        states = None if best is None else best.shooting.states(best.point)
        if best is not None and _too_many(delayed, seconds):
            # Such windows would be fitted as if all delays were equal.
            break
        for _ in range(ROUNDS):
            try:
                fit = refine(delayed, fit.theta, fit.latency_s, (seconds,), ITERATIONS, states=states)
            except InsufficientDataError:
                break
            if (seen := _linearised(delayed, fit)) is None:
                break
            free = [free_rows(r.residual, r.parameter, r.start, c) for r, c in zip(*seen, strict=True)]
            moved, shift, changed = moved_commands(delayed, fit.shooting.data, free, std_s)
            if changed <= SETTLED * sum(map(len, shift)):
                break
            delayed = _with(delayed, fit, std_s, shift, moved)
            states = fit.shooting.states(fit.point)
        if best is not None and fit.chi2 > WORSE * max(best.chi2, 1.0):
            break
        best = fit
    if best is None or best.shooting.problem.command_delays is None:
        return None
    found = replace(found, std_s=std_s * max(best.chi2, 1.0) ** 0.5)
    return DelayFit(best.shooting.problem, best, found, asked)


def most_delay_std_s(problem: Problem) -> float:
    """Return the largest standard deviation of delays [s]: half of the longest latency.

    So it is for every quantity between 0 and that (Popoviciu's inequality).
    """
    return problem.latency_range_s[1] / 2


def _too_many(problem: Problem, seconds: float) -> bool:
    """Return whether windows of a length hold more commands than can be told from noise."""
    try:
        windows = problem.windows(samples_in(problem, seconds))
    except InsufficientDataError:
        return False
    return any(commands_of(problem, data) > MOST_COMMANDS for data in windows)


def _with(
    problem: Problem,
    fit: Refined,
    std_s: float,
    shift: Sequence[Mapping[int, int]] | None = None,
    episodes: Sequence[SampledEpisode] | None = None,
) -> Problem:
    """Return the problem with random delays whose effects are computed at a fit."""
    known = problem.command_delays
    shift = known.shift if shift is None and known else shift or ()
    return problem.with_command_delays(CommandDelays(std_s, fit.theta, fit.latency_s, tuple(shift)), episodes)


def _linearised(problem: Problem, fit: Refined) -> tuple[list[WindowRows], list[FloatArray]] | None:
    """Return linearised residuals of a fit, whitened for the sensors' noise alone, and delays' columns.

    Columns that the fit has are taken, although they are of the values at which it began: those of the next
    round are of its own.
    """
    plain = problem.with_command_delays(None)
    shooting = Shooting(plain, fit.shooting.length)
    known: list[FloatArray] = []
    for data, fitted in zip(shooting.data, fit.shooting.data, strict=True):
        columns = fitted.by_delay
        if columns is None:
            columns = delay_columns(problem, fit.theta, fit.latency_s, data)
        if columns is None:
            return None
        known.append(columns)
    return list(shooting.normal(fit.point, keep=True).rows), known


def _likely(fit: Refined, rows: Sequence[FreeRows]) -> LikelyStd:
    """Return how large the standard deviation of the delays is at a fit."""
    problem = fit.shooting.problem
    width = np.append(problem.space.width, np.ptp(problem.latency_range_s))
    return likely_std(
        [r.residual for r in rows],
        [r.columns for r in rows],
        [r.parameter for r in rows],
        12.0 / width**2 + fit.normal.prior,
    )


def random_delay(seen: SeenErrors) -> RandomDelay | None:
    """Compare random delays beside other processes with these alone; None without enough windows."""
    return _random_delay(ComparedErrors.of(seen)) if seen.enough else None


def _random_delay(errors: ComparedErrors) -> RandomDelay:
    """Return how well random delays explain a residual, of which all processes are compared."""
    noise, delays, without = (errors.with_these(*these) for these in ((), ("delay",), FORCES))
    both, rival = (errors.with_these(*FORCES, late) for late in ("delay", "slow delay"))
    intensity = errors.covariances["delay"].intensity
    return RandomDelay(
        deviance=noise.deviance - delays.deviance,
        gain=without.deviance - both.deviance if both.deviance - rival.deviance < EVIDENCE else 0.0,
        share=both.shares["delay"],
        std_s=float(np.sqrt(both.sizes["delay"] * both.level / intensity)),
    )
