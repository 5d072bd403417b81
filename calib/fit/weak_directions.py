"""Derivatives along directions that the recordings hardly show, by differences along these directions.

The common scale of all masses, frictions and gains moves nothing, but each of them alone moves much. The
derivative along such a direction is a sum of columns that cancel. Dry friction makes kinks, so each column
is off by a percent or so, and what is left of the sum looks like information: on an arm driven by torques it
held a scale to 5 % that nothing holds. So predictions are compared a step along the direction to either side.

Symbols: J, derivatives of whitened residuals r by parameters and latency p, (M, K + 1); U, diagonal, standard
deviations expected of them; d = U e, a direction, e in units of U; H - P = J^T J, the data's information.

Source of the update: Broyden (1965), the smallest change of J that has the wanted product with one direction,
here in the norm of J U.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from deal_hw.calib.fit.one_step import of_rows
from deal_hw.calib.fit.residual import Normal, Point, Shooting, WindowRows, value_bounds
from deal_hw.sim.parameters import FORCE_KINDS
from deal_hw.types import FloatArray

WEAK_INFORMATION = 1e4
"""Information below which a direction is weak, relative to that of what was expected [-]: the recordings
leave more than a hundredth of the standard deviation that was expected."""

DIRECTION_STEP = 0.05
"""Step along it, as a share of the expected standard deviation of the parameter that moves most [-]."""

MOST_DIRECTIONS = 12
"""Most directions, the weakest: each costs two predictions of all windows."""


def with_weak_directions(shooting: Shooting, point: Point, normal: Normal) -> Normal:
    """Return normal equations with rows, their derivatives along weak directions simulated along these.

    The common scale of masses and forces is looked at in any case: in windows beside a chaotic motion sums of
    columns may say anything. Errors of a derivative look like information: kinks in sums of columns, bends in
    the step along a direction. So the derivative that says less is kept.

    Args:
        shooting: The windows.
        point: Where their residuals are linearised.
        normal: The normal equations there, with rows.
    """
    unit = _expected_std(shooting)
    normal = _along_each(shooting, point, normal, [scale_direction(shooting) / np.maximum(unit, 1e-300)])
    # Eigenvectors e of U (H - P) U: the data's information against what was expected.
    values, vectors = np.linalg.eigh((normal.hessian - np.diag(normal.prior)) * np.outer(unit, unit))
    weak = vectors[:, values < WEAK_INFORMATION].T[:MOST_DIRECTIONS]
    return _along_each(shooting, point, normal, weak)


def scale_direction(shooting: Shooting) -> FloatArray:
    """Return the direction in which all masses and forces that are searched grow alike, (K + 1,)."""
    scaled = [p.kind in FORCE_KINDS and p.scale == "log" for p in shooting.problem.space]
    return np.append(np.array(scaled, dtype=float), 0.0)


def _along_each(shooting: Shooting, point: Point, normal: Normal, directions: Iterable[FloatArray]) -> Normal:
    """Return normal equations with derivatives along directions, (K + 1,) in units of what was expected."""
    unit = _expected_std(shooting)
    for each in directions:
        moves = unit * each
        if not moves.any():
            continue
        step = DIRECTION_STEP / np.max(np.abs(each))
        by = _along(shooting, point, step * moves)
        if by is None:
            continue
        # J' = J + (c - J d) w^T, with the derivative c along d, and w = U^-1 e / |e|^2, so that w^T d = 1:
        # all that is across it in units of U keeps its derivative.
        dual = np.divide(each, unit, out=np.zeros_like(unit), where=unit > 0) / float(each @ each)
        rows = tuple(
            dataclasses.replace(
                r, parameter=r.parameter + (_padded(c / step, r) - r.parameter @ moves)[..., None] * dual
            )
            for r, c in zip(normal.rows, by, strict=True)
        )
        found = of_rows(shooting, point, normal, rows)
        # d^T H d, the information along d, of which errors of a derivative make more.
        if moves @ found.hessian @ moves < moves @ normal.hessian @ moves:
            normal = found
    return normal


def _expected_std(shooting: Shooting) -> FloatArray:
    """Return the standard deviation expected of parameters and latency, (K + 1,): a prior's, or a range's.

    A latency that stays as it is has 0.
    """
    low, high = value_bounds(shooting.problem)
    std = np.append(shooting.problem.space.prior[1], np.inf)
    found: FloatArray = np.minimum(std, (high - low) / np.sqrt(12.0))
    if shooting.fixed_latency:
        found[-1] = 0.0
    return found


def _along(shooting: Shooting, point: Point, step: FloatArray) -> list[FloatArray] | None:
    """Return the change of whitened residuals by a step, (W, R) an episode; None with no side in range."""
    low, high = value_bounds(shooting.problem)
    ends = {side: point.value + side * step for side in (1, -1)}
    sides = [side for side, end in ends.items() if np.all((low <= end) & (end <= high))]
    if not sides:
        return None
    moved = [shooting.residuals(dataclasses.replace(point, value=ends[side])) for side in sides]
    first, last = moved[0], moved[1] if len(sides) == 2 else shooting.residuals(point)
    found = []
    for up, down in zip(first, last, strict=True):
        # (r(p + h d) - r(p - h d)) / 2, or one side of it where a range ends: (r(p +- h d) - r(p)) / +-1.
        change = (up - down) / (len(sides) * sides[0])
        found.append(np.nan_to_num(change.reshape(len(change), -1), nan=0.0, posinf=0.0, neginf=0.0))
    return found


def _padded(change: FloatArray, rows: WindowRows) -> FloatArray:
    """Return a change of residuals, (W, R), with none of the start states' priors."""
    W, missing = len(change), rows.parameter.shape[1] - change.shape[1]
    return np.concatenate([change, np.zeros((W, missing))], axis=1)
