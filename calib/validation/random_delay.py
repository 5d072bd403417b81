"""Test for a random delay of each command, on the residual of a fit.

Random delays predict no sample, but they predict where the residual is large: each pushes in proportion to
the change of its command. Any other model error looks like a random force of constant size, white or slow, or
like delays that change slowly: dry friction that falls with speed holds the motion back where commands turn
round, over many of them. All are Gaussian processes beside white noise. Random delays are found where the
residual is likelier with them than with forces alone, and slow ones are not likelier still by more than
chance: a robot can have both. Then the fit is repeated with a delay of its own for each command; see
:mod:`deal_hw.calib.fit.command_delays`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import Bounds, minimize

from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import CommandDelays, Problem
from deal_hw.calib.fit.command_delays import (
    MOST_COMMANDS,
    command_spacing_s,
    command_times,
    commands_of,
    delay_columns,
    free_rows,
    likely_std,
    moved_commands,
)
from deal_hw.calib.fit.intervals import EVIDENCE, Uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import STAGES_S, WORSE, Refined, refine
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.validation.signatures import SignatureResponse, answers
from deal_hw.errors import InsufficientDataError
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

FEWEST_WINDOWS = 4
"""Fewest windows."""

MOST_ENTRIES = 2_000_000
"""Most entries of the windows' covariances; with more, windows are left out, spread over the recordings."""

ROWS = 320
"""Residuals of each window, from its start."""

SLOW_S = 0.1
"""Correlation time of the slow force, and of delays that change slowly [s]."""

VARIANCE_RATIO = (1e-5, 1e5)
"""Least and largest ratio of the mean variances of a process and the noise [-]."""

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

    def widened(self, known: Uncertainty, latency_s: float) -> Uncertainty:
        """Return an uncertainty that is at least that of the fit with one constant delay.

        Delays also take up a part of what else a model lacks, even where they leave nothing but noise. So
        they make no interval narrower. ``latency_s`` is the mean delay.
        """
        before = with_rows(self.before)
        wide = uncertainty_at(before.shooting.problem, before)
        std = np.zeros(len(known.space))
        std[: len(wide.space)] = np.sqrt(np.diag(wide.covariance))
        reach_s = wide.latency_reach_s(before.latency_s)
        return known.widened_to(std).latency_widened_to(
            reach_s, latency_s, before.shooting.problem.latency_range_s
        )


def fit_delays(problem: Problem, refined: Refined, least: float) -> DelayFit | None:
    """Return the fit with random delays of commands; None where its residual does not show any.

    Args:
        problem: The problem, with a constant delay.
        refined: Its fit.
        least: Least gain in deviance that shows them [-].
    """
    if problem.command_delays is not None or problem.noise_free or problem.robot.base is not None:
        return None
    if problem.known_std is not None:
        # A chosen residual scale is no noise beside which delays could be seen.
        return None
    still: tuple[dict[int, int], ...] = tuple({} for _ in problem.episodes)
    none = CommandDelays(0.0, refined.theta, refined.latency_s, still)
    # A fit that ended early has seen a part of the recordings only.
    part = refined.shooting.problem.with_command_delays(none)
    asked = refined
    while (seen := _seen(part, asked)) is None:
        # Its windows may hold too many commands, and those of the stage before it fewer.
        if asked.shorter is None:
            return None
        asked = asked.shorter
    rows, columns = seen
    times = [command_times(part, d, c.shape[2]) for d, c in zip(asked.shooting.data, columns, strict=True)]
    period_s = problem.episodes[0].period_s
    found = random_delay(rows, answers(part, asked), period_s, columns, times)
    if found is None or not found.gain > least:
        return None
    std_s, gain = _likely(part, asked, rows, columns)
    most_s = min(MOST_SPACED * command_spacing_s(problem), most_delay_std_s(problem))
    if not gain > least or std_s > most_s:
        return None
    delayed = _with(problem.with_command_delays(none), asked, std_s)
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
            if (seen := _seen(delayed, fit)) is None:
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
    return DelayFit(best.shooting.problem, best, found, refined)


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


def _seen(problem: Problem, fit: Refined) -> tuple[list[WindowRows], list[FloatArray]] | None:
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


def _likely(
    problem: Problem, fit: Refined, rows: Sequence[WindowRows], columns: Sequence[FloatArray]
) -> tuple[float, float]:
    """Return the likeliest standard deviation of the delays [s] at a fit, and its gain in deviance."""
    free = [free_rows(r.residual, r.parameter, r.start, c) for r, c in zip(rows, columns, strict=True)]
    width = np.append(problem.space.width, np.ptp(problem.latency_range_s))
    return likely_std(
        [f.residual for f in free],
        [f.columns for f in free],
        [f.parameter for f in free],
        12.0 / width**2 + fit.normal.prior,
    )


def random_delay(
    rows: Sequence[WindowRows],
    answers: Sequence[SignatureResponse],
    period_s: float,
    columns: Sequence[FloatArray] | None = None,
    times: Sequence[FloatArray] | None = None,
) -> RandomDelay | None:
    """Compare random delays beside other processes with these alone; None where there is nothing to compare.

    Residuals and the windows' responses to commands are given per episode, and the columns of
    :func:`delay_columns` with the times of their commands, (W, P) [s], if they are known. Without them each
    sample's change of a set-point has a delay.
    """
    every = [(e, w) for e, _ in enumerate(answers) for w in range(len(rows[e].residual))]
    entries = sum(len(r.residual) * min(r.residual.shape[1], ROWS) ** 2 for r in rows)
    chosen = every[:: max(-(-entries // MOST_ENTRIES), 1)]
    if len(chosen) < FEWEST_WINDOWS or not any(np.any(a.change) for a in answers):
        return None
    late = [None] * len(rows) if columns is None else columns
    when = [None] * len(rows) if times is None else times
    windows = [_Window.of(rows[e], answers[e], late[e], when[e], w) for e, w in chosen]
    change = np.concatenate([a.change.reshape(-1, a.change.shape[2]) for a in answers])
    rms = np.sqrt(np.mean(change**2, axis=0))
    residual = np.stack([window.residual for window in windows])
    followed = np.stack([window.parameter for window in windows])
    delay, scale = _process(windows, "delay", rms, period_s)
    slow_delay, *forces = (
        _process(windows, name, rms, period_s)[0] for name in ("slow delay", "white", "slow")
    )
    noise, delays, without = (_fitted(residual, followed, these)[0] for these in ([], [delay], forces))
    rival = _fitted(residual, followed, [*forces, slow_delay])[0]
    both, ratios, level = _fitted(residual, followed, [*forces, delay])
    return RandomDelay(
        deviance=noise - delays,
        gain=without - both if both - rival < EVIDENCE else 0.0,
        share=float(ratios[-1] / (1 + ratios.sum())),
        std_s=float(np.sqrt(ratios[-1] * level / scale)),
    )


@dataclass(frozen=True, slots=True)
class _Window:
    """The first residuals of a window without their projection on the start state.

    Attributes:
        residual: In the remaining directions, (D,).
        parameter: Their derivatives by parameters and latency, (D, K + 1).
        basis: These directions, (H M, D).
        response: Whitened response to a set-point, (A, H, M).
        change: Changes of the set-points, (H, A).
        late: Changes by the delay of each command, if known, (P, H M) [1/s].
        time_s: Times of these commands, (P,) [s].
    """

    residual: FloatArray
    parameter: FloatArray
    basis: FloatArray
    response: FloatArray
    change: FloatArray
    late: FloatArray | None
    time_s: FloatArray | None

    @classmethod
    def of(
        cls,
        rows: WindowRows,
        answer: SignatureResponse,
        late: FloatArray | None,
        time_s: FloatArray | None,
        w: int,
    ) -> _Window:
        R, S, M = rows.residual.shape[1], rows.start.shape[2], answer.response.shape[3]
        H = min(answer.response.shape[2], max(ROWS // M, 4))
        # The start state's prior comes last.
        kept = np.concatenate([np.arange(H * M), np.arange(R - S, R)])
        basis = np.linalg.qr(rows.start[w][kept], mode="complete")[0][:, S:] if S else np.eye(len(kept))
        residual = basis.T @ rows.residual[w][kept]
        known = None if late is None else late[w, : H * M].T
        parameter = basis.T @ rows.parameter[w][kept]
        return cls(
            residual=residual,
            parameter=parameter,
            basis=basis[: H * M],
            response=answer.response[:, w, :H],
            change=answer.change[w, :H],
            late=known,
            time_s=None if time_s is None else time_s[w],
        )


def _process(
    windows: Sequence[_Window],
    name: Literal["delay", "slow delay", "white", "slow"],
    rms: FloatArray,
    period_s: float,
) -> tuple[FloatArray, float]:
    """Return the covariance of late commands, or of forces as large as command changes, (A,) rms.

    It is that of the windows' residuals, (W, D, D), for a mean variance of 1. The mean variance of an
    intensity of 1 follows.
    """
    covariance = []
    for window in windows:
        A, H, M = window.response.shape
        late = name in ("delay", "slow delay")
        moved: FloatArray
        time_s: FloatArray
        if late and window.late is not None and window.time_s is not None:
            moved, time_s = window.late[None], window.time_s
        else:
            later = np.zeros((A, H, H, M))
            for k in range(H):
                later[:, k, k:] = window.response[:, : H - k]
            if late:
                # A command is late for all actuators.
                moved = np.asarray(np.einsum("ka,akhm->khm", window.change, later)).reshape(1, H, H * M)
            else:
                moved = (rms[:, None, None, None] * later).reshape(A, H, H * M)
            time_s = np.arange(H, dtype=np.float64) * period_s
        if name in ("slow", "slow delay"):
            apart = np.abs(np.subtract.outer(time_s, time_s))
            root = np.linalg.cholesky(np.exp(-apart / SLOW_S) + 1e-9 * np.eye(len(time_s)))
            moved = np.asarray(np.einsum("lk,alr->akr", root, moved))
        columns = moved.reshape(-1, H * M) @ window.basis
        covariance.append(columns.T @ columns)
    every = np.stack(covariance)
    scale = max(float(np.mean(np.einsum("wdd->wd", every))), 1e-300)
    return every / scale, scale


def _fitted(
    residual: FloatArray, followed: FloatArray, covariances: Sequence[FloatArray]
) -> tuple[float, FloatArray, float]:
    """Return the deviance of residuals, (W, D), from the most likely processes beside white noise.

    Their mean variances over that of the noise, and the noise's variance, follow. Parameters have followed
    the processes, so the likelihood is the restricted one (Patterson and Thompson 1971); ``followed`` holds
    the derivatives by them, (W, D, P).
    """
    W, D = residual.shape
    unit = np.broadcast_to(np.eye(D), (W, D, D))
    power = np.einsum("wdp,wdp->p", followed, followed)
    # Where the windows show nothing of a parameter, it follows nothing.
    seen = power > 0
    followed, weak = followed[..., seen] / np.sqrt(power[seen]), 1e-9 * np.eye(int(seen.sum()))
    count = residual.size - int(seen.sum())

    def likelihood(log_ratios: FloatArray) -> tuple[float, FloatArray, float]:
        """Return deviance, its gradient, and the noise's variance."""
        parts = [ratio * c for ratio, c in zip(np.exp(log_ratios), covariances, strict=True)]
        inverse = np.linalg.inv(sum(parts, unit))
        across = inverse @ followed
        information = np.einsum("wdp,wdq->pq", followed, across) + weak
        shift = np.linalg.solve(information, np.einsum("wdp,wd->p", across, residual))
        whitened = np.einsum("wij,wj->wi", inverse, residual - followed @ shift)
        level = max(float(np.sum(residual * whitened)) / count, 1e-300)
        deviance = count * np.log(level) - float(np.sum(np.linalg.slogdet(inverse)[1]))
        deviance += float(np.linalg.slogdet(information)[1])
        slope = []
        for part in parts:
            moved = np.einsum("wdp,wde,weq->pq", across, part, across, optimize=True)
            trace = np.sum(inverse * part) - np.trace(np.linalg.solve(information, moved))
            slope.append(trace - np.einsum("wi,wij,wj->", whitened, part, whitened, optimize=True) / level)
        return float(deviance), np.array(slope), level

    def cost(log_ratios: FloatArray) -> tuple[float, FloatArray]:
        return likelihood(log_ratios)[:2]

    found = np.zeros(len(covariances))
    if covariances:
        least, most = np.log(VARIANCE_RATIO)
        found = minimize(cost, found, jac=True, bounds=Bounds(least, most)).x
    deviance, _, level = likelihood(found)
    return deviance, np.exp(found), level
