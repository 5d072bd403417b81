"""Least squares as one writes it in an afternoon: one page on top of a simulator.

Windows of fixed length, back to back, start from smoothed reported states. SciPy's trust region minimises
the prediction errors of all windows, each joint over the spread of its signal, from the model's own values
within the ranges. There are no priors, no weights by noise, no robust loss, no second start, no choice among
fits and no laws. The latency is one more value.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.output_error import prediction_errors
from deal_hw.types import FloatArray

STEP = 1e-4
"""Step of finite differences, as a share of each range [-]."""
DIVERGED = 10.0
"""Error of a simulation that diverged, in spreads of the signal: SciPy takes no infinities [-]."""


def fit(problem: Problem, window_s: float) -> Member:
    """Return the values, (K,), and the latency [s] that predict windows of ``window_s`` [s] best."""
    space = problem.space
    low = np.append(space.to_scale(space.low), problem.latency_range_s[0])
    high = np.append(space.to_scale(space.high), problem.latency_range_s[1])
    spread = np.std(np.concatenate([_signal(problem, i) for i in range(len(problem.episodes))]), axis=0)

    def errors(shares: FloatArray) -> FloatArray:
        """Return the errors of members at shares of their ranges, (N, K + 1) -> (N, R)."""
        values = low + shares * (high - low)
        members = [(space.from_scale(one[:-1]), float(one[-1])) for one in values]
        found = [
            (np.where(data.reported, error, 0.0) / spread).reshape(len(members), -1)
            for data, error in prediction_errors(problem, members, window_s)
        ]
        every = np.concatenate(found, axis=1)
        return np.asarray(np.nan_to_num(every, nan=DIVERGED, posinf=DIVERGED, neginf=-DIVERGED))

    def error(share: FloatArray) -> FloatArray:
        """Return the errors at one point, (R,)."""
        return np.asarray(errors(share[None])[0])

    def derivatives(share: FloatArray) -> FloatArray:
        """Return the derivatives, (R, K + 1): forward, or backward at the upper end."""
        steps = np.where(share < 1 - STEP, STEP, -STEP)
        found = errors(share + np.concatenate([np.zeros((1, len(share))), np.diag(steps)]))
        return np.asarray(((found[1:] - found[0]) / steps[:, None]).T)

    first = np.append(space.to_scale(space.nominal), problem.first_latency_s)
    start = np.clip((first - low) / (high - low), 1e-6, 1 - 1e-6)
    found = least_squares(error, start, derivatives, bounds=(0.0, 1.0), max_nfev=60)
    values = low + found.x * (high - low)
    return np.clip(space.from_scale(values[:-1]), space.low, space.high), float(values[-1])


def _signal(problem: Problem, index: int) -> FloatArray:
    """Return the measured channels of a recording, (T, M)."""
    episode = problem.episodes[index]
    return np.concatenate([episode.position, episode.velocity], axis=1)[:, problem.channels]
