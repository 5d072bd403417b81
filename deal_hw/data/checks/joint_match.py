"""Matches commands to joints: finds a wrong order, a wrong sign, and clocks that disagree.

Commands and measurements are put on one grid and high-passed by differences over a tenth of a second, so that
poses and gravity do not count. C[i, j] is the correlation of the measurement of joint i with the command of
joint j, at the common lag at which the given pairs agree best. Joints with the same commands (legs that all
move together) cannot be distinguished and give no finding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.data.table import Table
from deal_hw.errors import MissingExtraError
from deal_hw.findings import Finding, Severity
from deal_hw.types import FloatArray, IntArray

WINDOW_S = 0.1
"""Differences are taken over this time [s]."""
MAX_LAG_S = 0.25
SURELY_BEFORE = 0.05
"""Correlation by which a lag before the commands must beat all after them to be refused [-]. A real servo
that a slow sine drives into its torque limit turns round early: 0.035 and 0.046."""
SLOW_S = 1.0
MAX_SAMPLES = 30_000
CLEAR = 0.3
"""Another assignment must raise the mean correlation of the reassigned joints by this much ..."""
GOOD = 0.6
"""... and to at least this much."""


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """Correlations at each lag.

    Attributes:
        names: Joints whose command and measurement both move, M of them.
        lags_s: (L,) [s]; positive where the measurement follows.
        correlation: (L, M, M): lag, measurement, command.
        level: Correlation of the positions themselves, (M,).
        slow: Correlation of the motion slower than a second, (M,).
        near: Nearness of the measurement of joint i to the command of joint j, (M, M), 0 to 1.
    """

    names: tuple[str, ...]
    lags_s: FloatArray
    correlation: FloatArray
    level: FloatArray
    slow: FloatArray
    near: FloatArray


def match(table: Table) -> tuple[Finding, Finding]:
    """Check order and sign of the joints, and that measurements follow commands."""
    found = _correlate(table)
    if found is None:
        text = "no joint's command and measurement both move enough to compare"
        return Finding("assignment", Severity.WARN, text), Finding("delay", Severity.OK, text)
    follows = found.lags_s >= -1e-9
    own = np.abs(np.diagonal(found.correlation, axis1=1, axis2=2)).mean(axis=1)
    # If joints are swapped, the given pairs do not show the lag, so each joint takes its best partner.
    best = np.abs(found.correlation).max(axis=2).mean(axis=1)
    at = int(np.argmax(np.where(follows, np.maximum(own, best), -1)))
    return _assignment(found, at), _delay(found, own if own.max() > GOOD else best)


def _correlate(table: Table) -> _Match | None:
    steps = np.diff(table.time_s)
    # A long recording is resampled, down to 50 Hz, which is faster with the same answer.
    coarse_s = min(float(table.time_s[-1]) / MAX_SAMPLES, 0.02)
    period = max(float(np.median(steps[steps > 0])), 2e-3, coarse_s)
    grid = np.arange(0.0, table.time_s[-1], period)
    measured, target = table.position_at(grid)[:, list(table.actuated_index)], table.target_at(grid)
    width = max(round(WINDOW_S / period), 1)
    lags = np.arange(-round(MAX_LAG_S / period), round(MAX_LAG_S / period) + 1)
    if grid.size < 4 * (width + lags[-1]):
        return None
    d_measured, d_target = measured[width:] - measured[:-width], target[width:] - target[:-width]
    spread = np.minimum(np.std(d_measured, axis=0), np.std(d_target, axis=0))
    moving = np.flatnonzero(spread > 1e-6 + 0.01 * np.max(np.std(d_measured, axis=0)))
    if not moving.size:
        return None
    x, y = d_measured[:, moving], d_target[:, moving]
    edge = lags[-1]
    middle = x[edge : len(x) - edge]
    shifted = [y[edge - lag : len(y) - edge - lag] for lag in lags]
    correlation = np.stack([_correlations(middle, part) for part in shifted])
    slow = max(round(SLOW_S / period), 1)
    coarse = [
        np.diff(part[: len(part) // slow * slow].reshape(-1, slow, moving.size).mean(axis=1), axis=0)
        for part in (measured[:, moving], target[:, moving])
    ]
    away = np.abs(np.median(measured[:, moving], axis=0)[:, None] - np.median(target[:, moving], axis=0))
    return _Match(
        names=tuple(table.actuated[i] for i in moving),
        lags_s=np.asarray(lags * period, dtype=np.float64),
        correlation=correlation,
        level=np.diagonal(_correlations(measured[:, moving], target[:, moving])),
        slow=np.diagonal(_correlations(*coarse)),
        near=1 / (1 + away / (np.ptp(measured[:, moving], axis=0)[:, None] + 1e-9)),
    )


def _correlations(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the correlation of each column of x with each of y; 0 without rows."""
    if not len(x):
        return np.zeros((x.shape[1], y.shape[1]))
    a, b = x - x.mean(axis=0), y - y.mean(axis=0)
    norm = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0)[None]
    return np.asarray(a.T @ b / np.where(norm > 0, norm, np.inf))


def _assignment(found: _Match, at: int) -> Finding:
    C = found.correlation[at]
    M = len(found.names)
    same = np.arange(M)
    # Among joints with the same commands the nearest level decides, then the given order.
    tie = 0.05 * found.near + 0.02 * np.eye(M)
    hypotheses = [
        ("order", best_assignment(C + tie), False),
        ("both", best_assignment(np.abs(C) + tie), True),
    ]
    best: tuple[float, str] | None = None
    signed = _wrong_signs(found, C)
    if signed.size:
        gain = float(np.mean(-2 * C[signed, signed]))
        names = ", ".join(found.names[i] for i in signed)
        best = (
            gain,
            f"the sign of {names} is wrong (correlation {np.min(C[signed, signed]):.2f}); set sign: -1",
        )
    for kind, order, with_signs in hypotheses:
        moved = np.flatnonzero(order != same)
        if not moved.size:
            continue
        score = np.abs(C[moved, order[moved]]) if with_signs else C[moved, order[moved]]
        before = np.abs(C[moved, moved]) if with_signs else C[moved, moved]
        gain = float(np.mean(score - before))
        if gain < CLEAR or float(np.min(score)) < GOOD:
            continue
        pairs = _pairs(found, C, order, moved)
        if best is not None and pairs in best[1]:
            continue
        # Wrong signs alone also explain it. They are simpler, so another order must explain clearly more.
        if best is not None and (kind == "both" or gain < best[0] + CLEAR / 2):
            best = best[0], f"{best[1]}; or joints are swapped: {pairs}"
            continue
        if best is None:
            best = gain, f"joints seem to be in another order: {pairs}"
    if best is not None:
        return Finding("assignment", Severity.FAIL, best[1])
    against = [f"{name} {C[i, i]:.2f}" for i, name in enumerate(found.names) if C[i, i] < -GOOD]
    if against:
        text = f"a joint moves against its command: {', '.join(against)}; check order and sign of the joints"
        return Finding("assignment", Severity.FAIL, text)
    weak = [f"{name} {C[i, i]:.2f}" for i, name in enumerate(found.names) if C[i, i] < CLEAR]
    if weak:
        text = f"command and measurement of a joint hardly move together: {', '.join(weak)}"
        return Finding(
            "assignment",
            Severity.WARN,
            f"{text}; check whether it is free, blocked, or another joint's channel, or whether commands and "
            "measurements have two clocks (the policy that moved the robot, --policy, shows that)",
        )
    return Finding(
        "assignment", Severity.OK, f"each of {M} joints follows its own command (at least {_least(C):.2f})"
    )


def _least(C: FloatArray) -> float:
    return float(np.min(np.diagonal(C)))


def _wrong_signs(found: _Match, C: FloatArray) -> IntArray:
    """Return the joints that move against their command.

    Either at every allowed lag and in their level; or in all motion slower than any lag.
    """
    follows = found.lags_s >= -1e-9
    own = np.diagonal(found.correlation, axis1=1, axis2=2)[follows]
    against = (-own.min(axis=0) > own.max(axis=0) + CLEAR) & (np.diagonal(C) < -GOOD) & (found.level < -0.5)
    return np.flatnonzero(against | ((found.slow < -GOOD) & (found.level < -CLEAR)))


def _pairs(found: _Match, C: FloatArray, order: IntArray, moved: IntArray) -> str:
    parts = []
    for i in moved:
        sign = " with the sign turned" if C[i, order[i]] < 0 else ""
        parts.append(
            f"the measurement of {found.names[i]} follows the command of {found.names[order[i]]}{sign} "
            f"({C[i, order[i]]:.2f}, its own {C[i, i]:.2f})"
        )
    return ", ".join(parts)


def _delay(found: _Match, own: FloatArray) -> Finding:
    at = int(np.argmax(own))
    lag_s, period = float(found.lags_s[at]), float(found.lags_s[1] - found.lags_s[0])
    text = f"measurements follow commands by about {lag_s * 1e3:.0f} ms"
    after = float(np.max(own[found.lags_s >= -1e-9]))
    if lag_s < -1.5 * period and own[at] > after + 0.01:
        text = (
            f"measurements come {-lag_s * 1e3:.0f} ms before the commands that they follow; check that "
            "both have one clock, and that the target column contains the sent commands"
        )
        sure = own[at] > after + SURELY_BEFORE
        return Finding("delay", Severity.FAIL if sure else Severity.WARN, text)
    if lag_s > MAX_LAG_S - period:
        return Finding(
            "delay",
            Severity.WARN,
            f"measurements follow commands by {lag_s:.2f} s or more; check the clocks and the target column",
        )
    return Finding("delay", Severity.OK, text)


def best_assignment(score: FloatArray) -> IntArray:
    """Return for each row the column that maximises the total score, each column once, (M,).

    Args:
        score: (M, M).

    Raises:
        MissingExtraError: scipy is not installed, and two rows have their maximum in one column.
    """
    # No assignment exceeds the sum of the rows' maxima. In most recordings each joint agrees best with its
    # own commands, so the base install, which has no scipy, can check and import them.
    highest = np.argmax(score, axis=1)
    if len(np.unique(highest)) == len(score):
        return np.asarray(highest, dtype=np.int64)
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError as err:
        raise MissingExtraError("scipy", "sim") from err
    return np.asarray(linear_sum_assignment(score, maximize=True)[1], dtype=np.int64)
