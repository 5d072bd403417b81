"""From where the polish ended to what is known there."""

from __future__ import annotations

import dataclasses

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished
from deal_hw.calib.uncertainty.intervals import CONTACT_KINKS, KINKS, Uncertainty, intervals, uncertainty
from deal_hw.types import FloatArray

NEAR = 0.1
"""Share of the polish's step in parameters: over a whole one dry friction kinks often enough to look like
information where a recording without noise has none."""


def with_rows(polished: Polished) -> Polished:
    """Return the same with linearised residuals, from which variances are clustered.

    Central differences where nothing kinks: what is said of directions without information depends on them.
    """
    if polished.normal.rows:
        return polished
    shooting = polished.shooting
    if shooting.problem.robot.base is None:
        normal = shooting.normal(polished.point, keep=True, stretch=NEAR, central=True)
    else:
        normal = shooting.normal(polished.point, keep=True)
    return dataclasses.replace(polished, normal=normal)


def statement(problem: Problem, polished: Polished, fixed_latency: bool) -> Uncertainty:
    """Return what the data say where the polish ended.

    Args:
        problem: The problem.
        polished: Where; variances are clustered where it holds linearised residuals.
        fixed_latency: The latency was given, or decided.
    """
    normal = polished.normal
    return uncertainty(
        problem.space,
        polished.theta,
        polished.latency_s,
        normal.hessian,
        polished.chi2,
        normal.residual,
        problem.latency_range_s,
        fixed_latency=fixed_latency,
        timing_std_s=problem.noise.timing_std_s,
        gradient=normal.gradient,
        prior=normal.prior,
        rows=normal.rows,
        kinks=KINKS if problem.robot.base is None or problem.exact else CONTACT_KINKS,
    )


def widened_to(problem: Problem, known: Uncertainty, theta: FloatArray, std: FloatArray) -> Uncertainty:
    """Return the statement with standard deviations that are at least these, correlations kept.

    Args:
        problem: The problem.
        known: The statement.
        theta: The estimate it is about, (K,).
        std: Least standard deviations in each parameter's own scale, (K,).
    """
    own = np.sqrt(np.diag(known.covariance))
    factor = np.maximum(std / np.maximum(own, 1e-300), 1.0)
    covariance = known.covariance * np.outer(factor, factor)
    return dataclasses.replace(
        known,
        covariance=covariance,
        interval=intervals(problem.space, theta, covariance, known.shape),
        widened=known.widened * factor,
    )
