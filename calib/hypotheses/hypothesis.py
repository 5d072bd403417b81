"""A hypothesis: what a model may lack, as parameters that it adds, when it is worth a fit, and its words.

A hypothesis is a model with more parameters. It is fitted to a part of the recordings and predicts the rest
(:mod:`deal_hw.calib.hypotheses.wider_models`). That prediction alone judges it
(:mod:`deal_hw.calib.hypotheses.judge`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.hypotheses.signatures import Cause
from deal_hw.calib.hypotheses.thresholds import FAR_CHI2
from deal_hw.calib.hypotheses.wider_models import wider_cost
from deal_hw.calibration import listed
from deal_hw.parameters import Parameter
from deal_hw.sim.parameters.laws import FREE_SPEED

TRIED = 0.02
"""Value whose effect is simulated where a fit begins at 0, as a share of the largest one [-]."""

SHAPES = ("dof_stribeck_speed",)
"""Kinds without an effect of their own: they shape that of another parameter."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What the model may lack and the robot may have.

    Attributes:
        name: What it is.
        cause: The cause that it stands for.
        parameters: Its parameters, those of a size first; none where it does not apply.
        means: What it means.
        do: What to do about it, with {} for the joints or bodies.
        taken: What to do where the result has it, with {} for the names of its parameters there.
        in_mjcf: Whether an MJCF can say it.
        certain: Whether each robot has it, so that a result with it has no weakness, whatever its values are.
        hidden: Whether its linearised effect around a fit without it says little, so that it is always
            fitted: within play nothing moves, and a lag looks like a delay, which the fit has.
        far: Whether it is asked around a poor fit, too, where linearised effects say nothing.
    """

    name: str
    cause: Cause
    parameters: Callable[[Problem], list[Parameter]]
    means: str
    do: str
    taken: str
    in_mjcf: bool = False
    certain: bool = False
    hidden: bool = False
    far: bool = False

    def worth_asking(self, chi2: float) -> bool:
        """Return whether it is asked around a fit without it that leaves this chi2."""
        return self.far or chi2 <= FAR_CHI2

    def worth_a_fit(self, gain: float, least: float) -> bool:
        """Return whether it is fitted where its linearised effect gains a deviance, of ``least`` or more."""
        return self.hidden or gain >= least

    def cost(self, problem: Problem, more: Sequence[Parameter]) -> float:
        """Return about how many physics steps a fit with its parameters takes, and its judgement."""
        return wider_cost(problem, True, len(more))

    def taken_as(self, names: Sequence[str], rivals: Sequence[str] = ()) -> str:
        """Return what to do where the result has it as these parameters.

        ``rivals`` are the names of others that explain the recordings alike.
        """
        do = self.taken.replace("{}", listed(list(names)))
        return do + f" Recordings like these do not tell it from {listed(list(rivals))}." if rivals else do


def off_value(p: Parameter) -> float:
    """Return the value at which a parameter has no effect, or the least in its range."""
    if p.kind == FREE_SPEED:
        return p.high
    return p.nominal if p.scale == "log" else 0.0


def sized(parameters: Sequence[Parameter]) -> list[int]:
    """Return the indices of parameters that have an effect of their own."""
    return [k for k, p in enumerate(parameters) if p.kind not in SHAPES]


def one_sided(problem: Problem, parameters: Sequence[Parameter]) -> npt.NDArray[np.bool_]:
    """Return which sized parameters have no effect at an end of their range, so that only one way is left."""
    # A filter of the MJCF is no end: the robot's lag may be shorter.
    free = () if problem.robot.filters is None else ("command_lag",)
    return np.array(
        [
            parameters[k].kind not in free
            and off_value(parameters[k]) in (parameters[k].low, parameters[k].high)
            for k in sized(parameters)
        ],
        dtype=bool,
    )


def values_in_words(parameters: Sequence[Parameter], values: Sequence[float]) -> str:
    """Return found values as in an alarm: "a.play = 0.01 rad and b.play = 0.02 rad".

    Those that are 0 are left out, if others are not: a fit found nothing there.
    """
    pairs = list(zip(parameters, values, strict=True))
    told = [(p, value) for p, value in pairs if value] or pairs
    return listed([f"{p.name} = {value:.2g} {p.unit}".rstrip(" -") for p, value in told])


def tried_value(p: Parameter) -> float:
    """Return a value with some effect."""
    off = off_value(p)
    return p.nominal if p.nominal != off else off + TRIED * (p.high - off)
