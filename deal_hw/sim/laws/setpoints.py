"""The set-point generator in front of a position servo: it moves towards the target at a limited speed.

MuJoCo has no such limit, so it is applied to the control before the engine. The set-point depends only on
targets, limit and time, never on the state. So whole episodes are computed at once, and a constant latency
only shifts it.
"""

from __future__ import annotations

import itertools

import numpy as np

from deal_hw.types import FloatArray


def slew(start: FloatArray, target: FloatArray, rate: FloatArray) -> FloatArray:
    """Follow a target at a limited rate.

    Args:
        start: Set-point before the first step, (N, A).
        target: Target in force at each step, (S, A) or (N, S, A).
        rate: Largest change a step, (N, A) or (N, S, A).

    Returns:
        The set-point after each step, (N, S, A).
    """
    count, steps = start.shape[0], target.shape[-2]
    targets = target if target.ndim == 3 else target[None]
    rates = rate if rate.ndim == 3 else rate[:, None]
    if steps and _never_binds(start, targets, rates):
        return np.broadcast_to(targets, (count, steps, start.shape[1]))
    out = np.empty((count, steps, start.shape[1]))
    now = start
    # Between changes of target and rate the set-point moves on a straight line until it arrives.
    for begin, end in itertools.pairwise(changes(steps, targets, rates)):
        reach = rates[:, min(begin, rates.shape[1] - 1), None] * np.arange(1, end - begin + 1)[:, None]
        gap = (targets[:, begin] - now)[:, None]
        out[:, begin:end] = now[:, None] + np.clip(gap, -reach, reach)
        now = out[:, end - 1]
    return out


def _never_binds(start: FloatArray, targets: FloatArray, rates: FloatArray) -> bool:
    """Return whether each target can be reached within the step in which it changes."""
    first = np.abs(targets[:, 0] - start) <= rates[:, 0]
    later = np.abs(np.diff(targets, axis=1)) <= (rates if rates.shape[1] == 1 else rates[:, 1:])
    return bool(first.all() and later.all())


def play(start: FloatArray, setpoint: FloatArray, width: FloatArray) -> FloatArray:
    """Return the output of a gear with play: it moves only when the play is used up.

    Args:
        start: Output before the first step, (N, A).
        setpoint: Input, (N, S, A).
        width: Width of the play, (N, A), at least 0.

    Returns:
        Output, (N, S, A).
    """
    out = np.empty_like(setpoint)
    half, now = width / 2, start
    for begin, end in itertools.pairwise(changes(setpoint.shape[1], setpoint)):
        now = np.clip(now, setpoint[:, begin] - half, setpoint[:, begin] + half)
        out[:, begin:end] = now[:, None]
    return out


def changes(steps: int, *series: FloatArray) -> list[int]:
    """Return 0, every step at which any of the series changes, and the number of steps."""
    changed = np.zeros(max(steps - 1, 0), dtype=bool)
    for values in series:
        if values.shape[1] > 1:
            changed |= np.any(values[:, 1:] != values[:, :-1], axis=(0, 2))
    return [0, *(np.flatnonzero(changed) + 1).tolist(), steps]


def delay(
    setpoint: FloatArray, latency_steps: FloatArray, before: FloatArray, last: int | None = None
) -> FloatArray:
    """Delay set-points by a latency, linear between steps.

    Args:
        setpoint: (N, S, A).
        latency_steps: Latency of each member in steps, (N,), or of each of its actuators, (N, A); may be
            fractional.
        before: Set-point before the first step, (N, A).
        last: Return only so many steps at the end; None for all S.

    Returns:
        The delayed set-point, (N, S, A) or (N, last, A).
    """
    if latency_steps.ndim == 1:
        latency_steps = latency_steps[:, None]
    whole = np.floor(latency_steps).astype(int)
    part = (latency_steps - whole)[:, None]
    steps = setpoint.shape[1]
    first = 0 if last is None else steps - last
    # A step before the first is read only where the latency is longer than what comes before a wanted one.
    longest = max(int(whole.max(initial=0)) + 1 - first, 0)
    padded = setpoint
    if longest:
        padded = np.concatenate([np.repeat(before[:, None], longest, axis=1), setpoint], axis=1)
    index = longest - whole[:, None] + np.arange(first, steps)[:, None]
    late = np.take_along_axis(padded, index, axis=1)
    if not part.any():
        return late
    later = np.take_along_axis(padded, index - 1, axis=1)
    return np.asarray((1 - part) * late + part * later)
