"""Zeros of encoders that differ between recordings: as parameters, in words, and of recordings not fitted.

An incremental encoder counts from where the robot was when it was switched on. Where friction holds a robot
off its rest, that is another place each time. No parameter of the robot expresses it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from deal_hw.calib.data.parts import samples_in
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.hypotheses.thresholds import WINDOW_S
from deal_hw.errors import InsufficientDataError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.own_setups import OWN, own_setup, recordings_of
from deal_hw.types import FloatArray

MOST_ZERO = 0.3
"""Largest offset of a zero that is searched [rad or m]. A larger one is seen by eye."""

MOST_NAMED = 6
"""Most recordings whose zero an alarm has."""


def own_zeros(joints: Mapping[str, str], recordings: Sequence[str]) -> list[Parameter]:
    """Return the zero of each joint in each recording.

    Args:
        joints: Units of the joints, by their names.
        recordings: Names of the recordings.
    """
    return [
        Parameter.encoder_bias(joint, MOST_ZERO, unit=unit, setup=own_setup(name))
        for name in recordings
        for joint, unit in joints.items()
    ]


def common_zeros(joints: Mapping[str, str]) -> list[Parameter]:
    """Return the zero of each joint in all recordings; ``joints`` are their units, by name."""
    return [Parameter.encoder_bias(joint, MOST_ZERO, unit=unit) for joint, unit in joints.items()]


def named_zeros(joint: str, unit: str, values: Mapping[str, float]) -> str:
    """Return a joint's zero in each recording in words."""
    each = [f"{value:+.2g} {unit} in {name}" for name, value in values.items()]
    more = f", and in {len(each) - MOST_NAMED} more" if len(each) > MOST_NAMED else ""
    return f"{joint}: {', '.join(each[:MOST_NAMED])}{more}"


def zeros_of(space: ParameterSpace, theta: FloatArray) -> dict[str, dict[str, float]]:
    """Return a fit's zeros of single recordings, by joint and recording; ``theta`` is (K,)."""
    found: dict[str, dict[str, float]] = {}
    for p, value in zip(space, theta, strict=True):
        if p.setup.startswith(OWN):
            found.setdefault(p.elements[0], {})[p.setup.removeprefix(OWN)] = float(value)
    return found


def next_zeros(space: ParameterSpace, theta: FloatArray) -> tuple[list[Parameter], FloatArray, FloatArray]:
    """Return the zeros of a recording that comes, as the fitted ones predict them, with mean and std, (L,).

    There are none where the fitted recordings have no zeros of their own.
    """
    found, units = zeros_of(space, theta), _joints(space)
    more = common_zeros({joint: units[joint] for joint in found})
    values = [np.array(list(each.values())) for each in found.values()]
    # That of a further draw from a Gaussian whose mean comes from n draws, too.
    std = [np.std(each, ddof=1) * np.sqrt(1 + 1 / len(each)) for each in values]
    return more, np.array([np.mean(each) for each in values]), np.array(std)


def with_other_zeros(space: ParameterSpace, episodes: Sequence[SampledEpisode]) -> ParameterSpace:
    """Return parameters with zeros of further recordings after them, if those of fitted ones are there."""
    known = {p.setup for p in space}
    names = [name for name in recordings_of(e.name for e in episodes) if own_setup(name) not in known]
    return ParameterSpace([*space.parameters, *own_zeros(_joints(space), names)])


def _joints(space: ParameterSpace) -> dict[str, str]:
    """Return the joints that have zeros in single recordings, with their units."""
    return {p.elements[0]: p.unit for p in space if p.setup.startswith(OWN)}


def fitted_zeros(problem: Problem, theta: FloatArray, latency_s: float) -> FloatArray:
    """Return a fit with the zeros of these recordings, which it has not seen, fitted to them alone.

    Without them no prediction of such a recording would begin in the right place. They are a few values for
    thousands of samples.

    Args:
        problem: The recordings, with the parameters of :func:`with_other_zeros`, L more than the fit's.
        theta: Values of the fit, (K,).
        latency_s: Its latency [s].

    Returns:
        The values with the zeros after them, (K + L,).
    """
    space, K = problem.space, len(theta)
    if len(space) == K:
        return theta
    held = dict(zip(space.names[:K], map(float, theta), strict=True))
    known = ParameterSpace(
        dataclasses.replace(p, known=True, nominal=held[p.name]) if p.name in held else p
        for p in space.holding(np.append(theta, space.nominal[K:])).parameters
    )
    part = problem.with_space(known).sharing(fixed_latency_s=latency_s)
    window_s = samples_in(part, WINDOW_S) * part.period_s
    try:
        found = refine(part, known.nominal, latency_s, (window_s,))
    except InsufficientDataError:
        return np.append(theta, known.nominal)
    zeros = found.theta if np.isfinite(found.chi2) else known.nominal
    return np.append(theta, zeros)
