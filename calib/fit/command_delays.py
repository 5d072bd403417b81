"""Random delays of commands: each command acts with its own, around the mean latency.

A command that acts late moves the robot late until the next one, so the errors of its samples are alike: one
unknown, not many. Least squares that takes them as noise of the sensors follows them, and its intervals are
too narrow. Here each delay is an unknown with a normal prior. Around the likeliest delays predictions are
straight in them, so they are eliminated: the residuals of a window have the covariance
1 + sum_k s^2 d_k d_k^T, where d_k is the change of the whitened predictions by a delay of command k and s the
delays' standard deviation. Residuals are whitened by its symmetric root (generalised least squares, Aitken
1936).

Symbols: C, the columns d_k of a window, (H M, P) [1/s]; s [s]; V = 1 + s^2 C C^T, (H M, H M). With the
singular vectors U of C and g = s^2 (singular values)^2: V^-1 = 1 - U diag(g / (1 + g)) U^T and
V^(-1/2) = 1 - U diag(1 - (1 + g)^(-1/2)) U^T.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.windows import setpoints
from deal_hw.types import FloatArray, IntArray

EARLIER_COMMANDS = 8
"""Commands before a window whose delays still count [-]: a slewing set-point is behind until it arrives."""

MOST_COMMANDS = 120
"""Most commands in a window; with more, delays of single commands cannot be separated from noise."""

DELAY_STD_S = (1e-5, 0.1)
"""Least and largest standard deviation of delays that is looked for [s]."""

UNLIKELY = 2.71
"""Deviance above the least one at which a larger standard deviation of delays is ruled out [-]: chance goes
as far in one of twenty cases on that side (chi-square with one degree of freedom; Wilks 1938)."""


def with_command_delays(problem: Problem, windows: Sequence[WindowData]) -> list[WindowData]:
    """Return windows whose residuals are whitened for the random delays that the problem states, if any.

    Where commands were moved already, the measurements are moved by the straight part of that: delays are
    unknowns around the mean, not around where the commands are now.
    """
    known = problem.command_delays
    if known is None:
        return list(windows)
    found = []
    for data in windows:
        columns = delay_columns(problem, known.theta, known.latency_s, data)
        if columns is None:
            found.append(data)
            continue
        moved = (columns @ shifts(problem, data, columns.shape[2])[..., None])[..., 0]
        std = np.where(data.reported, data.std, 0.0)
        # V^(-1/2) = 1 - late late^T. Thin: a window has fewer commands than measurements.
        root, size, _ = np.linalg.svd(known.std_s * columns, full_matrices=False)
        late = root * np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + size**2))[:, None]
        measured = data.measured + std * moved.reshape(data.measured.shape)
        found.append(dataclasses.replace(data, measured=measured, late=late, by_delay=columns))
    return found


def delay_columns(
    problem: Problem, theta: FloatArray, latency_s: float, data: WindowData
) -> FloatArray | None:
    """Return the change of whitened predictions by a delay of each command, (W, H M, P) [1/s].

    Commands have numbers modulo P, and no two of one number count in one window. None: no command changes, or
    there are too many.
    """
    episode = problem.episodes[data.episode]
    begins = command_begins(episode)
    P = commands_of(problem, data)
    if not 0 < P <= MOST_COMMANDS:
        return None
    targets = np.repeat(episode.target[None], 1 + P, axis=0)
    for k in range(P):
        late = begins[k::P]
        targets[1 + k, late] = episode.target[late - 1]
    batch = problem.batch(1 + P, data.episode)
    batch.set_parameters(np.repeat(theta[None], 1 + P, axis=0))
    path = setpoints(batch, episode, np.full(1 + P, latency_s), targets)
    observed = problem.predict_along(batch, path, data).observed
    change = np.nan_to_num((observed[1:] - observed[:1]) / data.std, nan=0.0, posinf=0.0, neginf=0.0)
    return np.asarray(np.moveaxis(change, 0, -1).reshape(len(data.windows), -1, P) / episode.step_s)


def commands_of(problem: Problem, data: WindowData) -> int:
    """Return the number of commands that count in one window of an episode; 0 where none begins in any."""
    begins = command_begins(problem.episodes[data.episode])
    start = problem.episodes[data.episode].sample[data.windows.start]
    count = _in_window(start, data.windows.length * data.windows.stride, begins)
    return min(count + EARLIER_COMMANDS, len(begins)) if count else 0


def command_begins(episode: SampledEpisode) -> IntArray:
    """Return the device periods in which another target begins, (n,)."""
    return np.flatnonzero(np.any(np.diff(episode.target, axis=0) != 0, axis=1)) + 1


def command_spacing_s(problem: Problem) -> float:
    """Return the median time from one new target to the next [s]; 0 where none changes."""
    between = np.concatenate([np.diff(command_begins(e)) * e.step_s for e in problem.episodes])
    return float(np.median(between)) if between.size else 0.0


def _numbers(problem: Problem, data: WindowData, P: int) -> IntArray:
    """Return which command each column of a window stands for, (W, P): the last one of its number; or -1."""
    episode = problem.episodes[data.episode]
    begins = command_begins(episode)
    ends = episode.sample[data.windows.start] + data.windows.length * data.windows.stride
    last = np.searchsorted(begins, ends)[:, None] - 1
    return np.asarray(np.maximum(last - (last - np.arange(P)) % P, -1))


def command_times(problem: Problem, data: WindowData, P: int) -> FloatArray:
    """Return when the command of each column of a window begins, (W, P) [s]."""
    episode = problem.episodes[data.episode]
    begins = command_begins(episode)
    return np.asarray(begins[_numbers(problem, data, P)] * episode.step_s)


def shifts(problem: Problem, data: WindowData, P: int) -> FloatArray:
    """Return by how much the command of each column was moved already, (W, P) [s]."""
    episode, known = problem.episodes[data.episode], problem.command_delays
    if known is None:
        return np.zeros((len(data.windows), P))
    moved = known.shift[data.episode]
    each = np.array([moved.get(int(b), 0) for b in command_begins(episode)] + [0])
    return np.asarray(each[_numbers(problem, data, P)] * episode.step_s)


def _in_window(start: IntArray, steps: int, begins: IntArray) -> int:
    """Return the most commands that begin within a window."""
    inside = np.searchsorted(begins, start + steps) - np.searchsorted(begins, start)
    return int(np.max(inside, initial=0))


class LikelyStd(NamedTuple):
    """How large the standard deviation of delays is.

    Attributes:
        std_s: The likeliest one [s].
        gain: Its gain in deviance over no delays.
        most_s: The largest one that the residual leaves possible [s]; see `UNLIKELY`.
    """

    std_s: float
    gain: float
    most_s: float


def likely_std(
    residuals: Sequence[FloatArray],
    columns: Sequence[FloatArray],
    jacobians: Sequence[FloatArray],
    belief: FloatArray,
) -> LikelyStd:
    """Return how large the standard deviation of delays is.

    It is relative to the size of the sensors' noise, which is estimated, too. The likelihood is the
    restricted one (Patterson and Thompson 1971): a fit follows the delays of its commands, so its residual
    alone shows too little of them.

    Args:
        residuals: Whitened residuals, orthogonal to the start states, (W, D) per episode.
        columns: Their changes by delays, likewise, (W, D, P) [1/s].
        jacobians: Their changes by the fitted values, likewise, (W, D, K + 1).
        belief: Prior information on the fitted values, (K + 1,).
    """
    K = len(belief)
    power, count, information, score = 0.0, -K, np.diag(belief), np.zeros(K)
    sizes, along = [], []
    for residual, column, jacobian in zip(residuals, columns, jacobians, strict=True):
        root, size, _ = np.linalg.svd(column, full_matrices=False)
        both = np.concatenate([jacobian, residual[..., None]], axis=2)
        sizes.append(size.ravel())
        along.append(np.einsum("wdp,wdk->wpk", root, both).reshape(-1, K + 1))
        power, count = power + float(np.sum(residual**2)), count + residual.size
        information += np.einsum("wdi,wdj->ij", jacobian, jacobian)
        score += np.einsum("wdi,wd->i", jacobian, residual)
    size2, by = np.concatenate(sizes) ** 2, np.concatenate(along)

    def deviance(log_std: float) -> float:
        # Residuals r = J x + C d + e, (n,), with e of an unknown variance and K fitted values x. Minus twice
        # the restricted log-likelihood without constants, that variance profiled out:
        # (n - K) ln(q / (n - K)) + ln|V| + ln|H|, with H = J^T V^-1 J + prior, g = J^T V^-1 r and
        # q = r^T V^-1 r - g^T H^-1 g.
        gain = np.exp(2 * log_std) * size2
        shrunk = by * (gain / (1 + gain))[:, None]
        H = information - by[:, :K].T @ shrunk[:, :K]
        g = score - by[:, :K].T @ shrunk[:, K]
        left = power - float(by[:, K] @ shrunk[:, K]) - float(g @ np.linalg.solve(H, g))
        return float(count * np.log(left / count) + np.sum(np.log1p(gain)) + np.linalg.slogdet(H)[1])

    least, most = np.log(DELAY_STD_S)
    best = minimize_scalar(deviance, bounds=(least, most), method="bounded")
    limit = float(best.fun) + UNLIKELY
    end = brentq(lambda x: deviance(x) - limit, best.x, most) if deviance(most) > limit else most
    return LikelyStd(float(np.exp(best.x)), deviance(-np.inf) - float(best.fun), float(np.exp(end)))


@dataclass(frozen=True, slots=True)
class FreeRows:
    """Residuals of one episode's windows in the directions that start states leave free.

    Attributes:
        residual: Whitened for the sensors' noise, (W, D).
        columns: Their changes by the commands' delays, (W, D, P) [1/s].
        parameter: Their changes by the fitted values, (W, D, K + 1).
    """

    residual: FloatArray
    columns: FloatArray
    parameter: FloatArray


def free_rows(
    residual: FloatArray, parameter: FloatArray, start: FloatArray, columns: FloatArray
) -> FreeRows:
    """Return linearised residuals, and columns of :func:`delay_columns`, without the start states.

    Args:
        residual: Of an episode's windows, whitened for the sensors' noise, (W, R); the last S rows are the
            prior of the start states.
        parameter: Their derivatives by the fitted values, (W, R, K + 1).
        start: Their derivatives by the start states, (W, R, S).
        columns: Their derivatives by the commands' delays without the last S rows, (W, R - S, P) [1/s].
    """
    W, _, S = start.shape
    columns = np.concatenate([columns, np.zeros((W, S, columns.shape[2]))], axis=1)
    if not S:
        return FreeRows(residual, columns, parameter)
    across = np.swapaxes(np.linalg.qr(start, mode="complete")[0][:, :, S:], 1, 2)
    return FreeRows((across @ residual[..., None])[..., 0], across @ columns, across @ parameter)


def moved_commands(
    problem: Problem, episodes: Sequence[WindowData], rows: Sequence[FreeRows], std_s: float
) -> tuple[list[SampledEpisode], tuple[dict[int, int], ...], int]:
    """Return the episodes with each command moved by its likeliest delay, in whole periods.

    Their shifts, and how many commands moved, follow. ``rows`` are those of ``episodes``' windows; commands
    without windows stay.
    """
    known = problem.command_delays
    found, shift = list(problem.episodes), [dict(s) for s in known.shift] if known else []
    changed = 0
    for data, row in zip(episodes, rows, strict=True):
        episode = problem.episodes[data.episode]
        P = row.columns.shape[2]
        before = shifts(problem, data, P)
        normal = np.einsum("wdp,wdq->wpq", row.columns, row.columns) + np.eye(P) / std_s**2
        pull = np.einsum("wdp,wd->wp", row.columns, row.residual) + before / std_s**2
        # The likeliest delays minimise |r + C (d - d_before)|^2 + |d|^2 / s^2.
        wanted = before - np.linalg.solve(normal, pull[..., None])[..., 0]
        begins, numbers = command_begins(episode), _numbers(problem, data, P)
        # A command is judged by the window that shows it best.
        shown = np.einsum("wdp,wdp->wp", row.columns, row.columns)
        best = np.zeros(len(begins))
        whole = np.array([known.shift[data.episode].get(int(b), 0) if known else 0 for b in begins])
        was = whole.copy()
        for w, of_window in enumerate(numbers):
            for p, k in enumerate(of_window):
                if k >= 0 and shown[w, p] > best[k]:
                    best[k], whole[k] = shown[w, p], round(wanted[w, p] / episode.step_s)
        changed += int(np.sum(whole != was))
        place = np.maximum.accumulate(np.clip(begins - was + whole, 1, episode.steps - 1))
        target = np.repeat(episode.target[:1], episode.steps, axis=0)
        for k, b in enumerate(begins):
            target[place[k] :] = episode.target[b]
        found[data.episode] = dataclasses.replace(episode, target=target)
        shift[data.episode] = dict(zip(map(int, place), map(int, whole), strict=True))
    return found, tuple(shift), changed
