"""Is the physics step too coarse? Found by predicting once more with half the step.

An integrator of first order (MuJoCo's Euler, implicit and implicitfast) errs in proportion to its step, and
a fit turns that error into damping, armature or delay. Half the step removes half of it, so where the fit
would go with half the step says how far the step has moved it: twice as far. Whether the recordings agree
with the finer step is asked too: data that were simulated with the model's own step do not.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Polished
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.uncertainty.at_fit import widened_to
from deal_hw.calib.uncertainty.cluster_robust import eliminated, without_starts
from deal_hw.calib.uncertainty.intervals import Z90, Uncertainty
from deal_hw.calibration import Alarm, listed
from deal_hw.types import FloatArray

CLEARLY = 4.0
"""Chi-square by which one step must explain the recordings better than the other [-]. Where the finer step
is in truth d standard deviations worse the difference is -d^2 with a spread of 2 d, so by chance it is above
4 in at most 2.3 % of recordings, whatever d is."""

MOST_STEPS = 3e8
"""More physics steps than this are not spent on the comparison."""


@dataclass(frozen=True, slots=True)
class StepCheck:
    """What half the physics step says.

    Attributes:
        step_s: The model's physics step [s].
        bias: By how much the step moves each parameter, in its own scale, and the latency [s], (K + 1,).
        gain: By how much less chi-square half the step leaves; negative where it leaves more.
        note: Why nothing was compared.
    """

    step_s: float
    bias: FloatArray
    gain: float = 0.0
    note: str = ""

    @property
    def rejected(self) -> bool:
        """Whether the recordings speak against the finer step, as simulated ones do."""
        return self.gain < -CLEARLY

    @property
    def preferred(self) -> bool:
        """Whether the recordings ask for the finer step."""
        return self.gain > CLEARLY

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        if self.note:
            return {"step_s": self.step_s, "note": self.note}
        return {"step_s": self.step_s, "bias": self.bias.tolist(), "chi2_gain": self.gain}


def check_step(problem: Problem, polished: Polished) -> StepCheck:
    """Compare predictions with the model's step and with half of it.

    Args:
        problem: Recordings and simulator.
        polished: Where the fit ended, with linearised residuals.
    """
    step_s, K = problem.robot.step_s, len(problem.space)
    nothing = np.zeros(K + 1)
    if problem.robot.base is not None:
        # Feet that touch at another moment change a prediction more than the step's error does.
        return StepCheck(step_s, nothing, note="not compared for robots in contact")
    shooting, rows = polished.shooting, polished.normal.rows
    samples = sum(len(d.windows) * d.windows.length * d.windows.stride for d in shooting.data)
    steps = 3.0 * samples * problem.episodes[0].step_s / step_s
    if steps > MOST_STEPS:
        return StepCheck(step_s, nothing, note=f"not compared: it would take {steps:.1g} physics steps")
    finer = Shooting(halved(problem), shooting.length, data=shooting.data)
    before, after = shooting.residuals(polished.point), finer.residuals(polished.point)
    if not all(np.isfinite(r).all() for r in after):
        return StepCheck(step_s, nothing, note="not compared: half the step diverged")
    moved = [_shifted(r, b - a) for r, a, b in zip(rows, before, after, strict=True)]
    width = np.append(problem.space.width, np.ptp(problem.latency_range_s))
    belief = polished.normal.prior + 12.0 / width**2
    if problem.fixed_latency_s is not None:
        # A latency that is given takes nothing of the step's error.
        belief[-1] = np.inf
    cost, where = _refitted(rows, belief)
    finer_cost, finer_where = _refitted(moved, belief)
    # First order: half the step removes half of what the whole step is off.
    return StepCheck(step_s, 2.0 * (finer_where - where), cost - finer_cost)


def counted(problem: Problem, known: Uncertainty, theta: FloatArray, found: StepCheck) -> Uncertainty:
    """Return what is known, intervals as much wider as the step moves their parameters.

    Args:
        problem: Says the range of the latency.
        known: What was known before.
        theta: The estimate, (K,).
        found: What half the step says; nothing changes where the recordings speak against it.
    """
    if found.note or found.rejected:
        return known
    std = np.sqrt(np.diag(known.covariance)) + np.abs(found.bias[:-1]) / Z90
    known = widened_to(problem, known, theta, std)
    (first, last), (low, high) = problem.latency_range_s, known.latency_interval_s
    if low == high:
        return known
    more = abs(float(found.bias[-1]))
    return dataclasses.replace(known, latency_interval_s=(max(low - more, first), min(high + more, last)))


def step_alarm(problem: Problem, known: Uncertainty, found: StepCheck) -> tuple[Alarm, ...]:
    """Return the alarm of a step that is too coarse; none where it is fine.

    Args:
        problem: Says the parameters' names.
        known: What was known before the step was counted.
        found: What half the step says.
    """
    if found.note or not found.preferred:
        return ()
    half_width = Z90 * np.sqrt(np.diag(known.covariance))
    moved = np.abs(found.bias[:-1]) > half_width
    names = [n for n, m, b in zip(problem.space.names, moved, known.shape.blind, strict=True) if m and not b]
    if not names:
        return ()
    return (
        Alarm(
            f"With half the physics step ({500 * found.step_s:g} ms) the recordings are explained better "
            "(chi-square "
            f"{found.gain:.3g} lower), and these would leave their intervals: {listed(names)}.",
            f"A step of {1e3 * found.step_s:g} ms is too coarse: its error went into these values.",
            f"Calibrate with --physics-step {found.step_s / 2:g} or less, and train with that step.",
        ),
    )


def halved(problem: Problem) -> Problem:
    """Return the problem with half the physics step; recordings, noise and smoothed states are shared."""
    model = copy.copy(problem.robot.model)
    model.opt.timestep /= 2.0
    return problem.with_robot(dataclasses.replace(problem.robot, model=model))


def _shifted(rows: WindowRows, change: FloatArray) -> WindowRows:
    """Return the rows with predictions changed, (W, H, M) whitened; what is known of start states stays."""
    residual = rows.residual.copy()
    residual[:, : change[0].size] += change.reshape(len(change), -1)
    return dataclasses.replace(rows, residual=residual)


def _refitted(
    rows: tuple[WindowRows, ...] | list[WindowRows], belief: FloatArray
) -> tuple[float, FloatArray]:
    """Return the cost that a linear refit leaves, and the step to it, (K + 1,).

    Args:
        rows: Linearised residuals.
        belief: What is known of parameters and latency without the data, (K + 1,).
    """
    P = len(belief)
    cost, gradient, hessian = 0.0, np.zeros(P), np.diag(belief)
    for one in rows:
        jacobian, normal = eliminated(one)
        residual = without_starts(one.start, normal, one.residual[..., None])[..., 0]
        cost += float(np.sum(residual**2))
        gradient += np.einsum("wri,wr->i", jacobian, residual)
        hessian += np.einsum("wri,wrj->ij", jacobian, jacobian)
    free = np.isfinite(belief)
    step = np.zeros(P)
    step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
    return cost + float(gradient @ step), np.asarray(step, dtype=np.float64)
