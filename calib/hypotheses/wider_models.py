"""Wider models as candidates: with more parameters, fitted to a part of the data, they predict the rest.

The model as it is gets two chances: its fit to all recordings, and a fit to the same part that begins where
the wider one ended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.parts import BEGIN_S, part_of, samples_in
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.fit.refinement import Refined, at_parameters, refine
from deal_hw.calib.fit.solver import independent_samples
from deal_hw.calib.hypotheses.judge import UnseenGain
from deal_hw.calib.hypotheses.thresholds import WINDOW_S
from deal_hw.errors import CalibrationError, InsufficientDataError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.parameters import KIND_TABLE
from deal_hw.sim.parameters.default_space import left_at_zero
from deal_hw.types import FloatArray

MOST_INERTIA = 20.0
"""Largest armature that is tried where the model has 0, in inertias of the joint [-]. A real cart has six
times its mass."""

MOST_FORCE = 5.0
"""The same of dry friction, and of damping at the joint's rms speed, in rms forces that its inertia needed
[-]."""


@dataclass(frozen=True, slots=True)
class WiderFit:
    """A fit with more parameters, to a part of the recordings.

    Attributes:
        of: The recordings, without these parameters.
        more: The parameters.
        fit: The fit.
        prediction: The fitted values on the samples that were not fitted.
    """

    of: Problem
    more: Sequence[Parameter]
    fit: Refined
    prediction: Refined

    @property
    def found(self) -> FloatArray:
        """Values of the further parameters."""
        return self.fit.theta[len(self.of.space) :]

    def shift_of(self, refined: Refined) -> FloatArray:
        """Return the change of the own parameters, in their scales, and of the latency [s], (K + 1,)."""
        space = self.of.space
        own = space.to_scale(self.fit.theta[: len(space)]) - space.to_scale(refined.theta)
        return np.append(own, self.fit.latency_s - refined.latency_s)

    def significance(self, off: FloatArray | float = 0.0) -> FloatArray:
        """Return how far the further parameters are from values without effect, in standard deviations, (L,).

        Args:
            off: These values, (L,).
        """
        K, count = len(self.of.space), len(self.more)
        space = ParameterSpace(self.more)
        moved = space.to_scale(self.found) - space.to_scale(np.broadcast_to(off, count))
        covariance = np.linalg.pinv(self.fit.normal.hessian) * max(self.fit.chi2, 1.0)
        std = np.sqrt(np.maximum(np.diag(covariance)[K : K + count], 1e-300))
        return np.asarray(moved / std)


def fit_wider(
    problem: Problem, more: Sequence[Parameter], seconds: float = BEGIN_S, start: Member | None = None
) -> WiderFit | None:
    """Fit with more parameters to a part of the recordings; None where it cannot be fitted.

    Args:
        problem: The recordings.
        more: The further parameters.
        seconds: Length of the part [s], if it is longer than :data:`BEGIN_S`; at most half of the recordings.
        start: Where the fit begins; the model's own values by default.
    """
    wide = problem.with_more(more)
    total_s = sum(len(e.sample) * e.period_s for e in problem.episodes)
    part = part_of(wide, min(max(BEGIN_S, seconds), total_s / 2))
    seen = [e.usable for e in part.episodes]
    rest = [e.usable & ~mask for e, mask in zip(problem.episodes, seen, strict=True)]
    theta, latency_s = start or (wide.space.nominal, problem.first_latency_s)
    try:
        fit = refine(part, theta, latency_s, (WINDOW_S,))
        length = samples_in(problem, WINDOW_S)
        prediction = at_parameters(wide.part(rest), fit.theta, fit.latency_s, length)
    except (InsufficientDataError, CalibrationError):
        return None
    return WiderFit(problem, more, fit, prediction)


def wider_cost(problem: Problem, fits: bool, more: int = 0) -> float:
    """Return about how many physics steps a wider model takes, with its fit or from one.

    Each fit takes about half of its most iterations. The model as it is gets one, too.
    """
    total_s = sum(len(e.sample) * e.period_s for e in problem.episodes)
    periods = min(BEGIN_S, total_s / 2) / problem.robot.step_s
    # Derivatives by each value and start state, of independent trees at once, and a line of damped steps.
    members = 12 + (len(problem.space) + more + 2 * problem.coordinates) / problem.independent
    predictions = total_s / problem.robot.step_s
    return 6.0 * members * periods * (2 if fits else 1) + 2.0 * predictions


def held_out(wide: WiderFit, refined: Refined, asked: int = 1) -> UnseenGain | None:
    """Return what a wider fit gains over the model as it is; None where no judge would accept that.

    The model as it is gets two chances, of which the better one counts.

    Args:
        wide: The wider fit.
        refined: The fit without its parameters, which has used all recordings.
        asked: How many hypotheses the judge asks.
    """
    problem, fit, prediction = wide.of, wide.fit, wide.prediction
    seen, unseen = (
        problem.part([e.usable for e in part.shooting.problem.episodes]) for part in (fit, prediction)
    )
    length, left = prediction.shooting.length, prediction.normal
    # What it leaves counts once for each correlation time. What it explains is alike over many samples, too.
    sizes = [r.size for r in left.residual]
    count = left.count * independent_samples(left.residual, sizes, left.periods_s) / sum(sizes)

    def gained(theta: FloatArray, latency_s: float) -> UnseenGain:
        return UnseenGain(at_parameters(unseen, theta, latency_s, length).chi2, prediction.chi2, count)

    try:
        found = gained(refined.theta, refined.latency_s)
        if not found.promises(asked):
            return None
        # The wider fit may have left another minimum; a fit from there without more then predicts as well.
        bare = refine(seen, fit.theta[: len(problem.space)], fit.latency_s, (WINDOW_S,))
        again = gained(bare.theta, bare.latency_s)
    except (InsufficientDataError, CalibrationError):
        return None
    return min(found, again, key=lambda each: each.before)


def motion(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the joints' rms speed and the rms force that their inertia needed, (J,) each."""
    robot = problem.robot
    inertia = robot.model.dof_M0[list(robot.qvel)]
    joints = range(problem.coordinates)[robot.joints]
    speed, push = np.zeros(len(inertia)), np.zeros(len(inertia))
    for j, c in enumerate(joints):
        moved = [s.velocity[:, c] for s in problem.starts]
        speed[j] = np.sqrt(np.mean(np.concatenate(moved) ** 2))
        accelerations = [np.gradient(v, e.period_s) for v, e in zip(moved, problem.episodes, strict=True)]
        push[j] = inertia[j] * np.std(np.concatenate(accelerations))
    return speed, push


def zero_parameters(problem: Problem) -> list[Parameter]:
    """Return friction, damping and armature of joints that have none in the model and were not searched."""
    robot, searched = problem.robot, {(p.kind, e) for p in problem.space.parameters for e in p.elements}
    if robot.base is not None:
        return []
    names = list(robot.description.joint_names)
    inertia = robot.model.dof_M0[list(robot.qvel)]
    speed, push = motion(problem)
    most = {
        "dof_armature": MOST_INERTIA * inertia,
        "dof_frictionloss": MOST_FORCE * push,
        "dof_damping": MOST_FORCE * push / np.maximum(speed, 1e-9),
    }
    found = []
    for kind, elements in left_at_zero(robot.model).items():
        for name in elements:
            if name not in names or (kind, name) in searched:
                continue
            quantity, j = KIND_TABLE[kind], names.index(name)
            found.append(
                Parameter(
                    name=f"{name}.{quantity.quantity}",
                    kind=kind,
                    elements=(name,),
                    unit=quantity.unit_of(robot.model, robot.model.joint(name).id),
                    nominal=0.0,
                    low=0.0,
                    high=float(most[kind][j]),
                    scale="linear",
                )
            )
    return found
