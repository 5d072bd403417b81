"""Where a residual lies that no known cause explains: which channel, and at which positions of which joint.

A sensor that is blind or bent in a part of its range, an end stop or a cable leave their residual at the same
positions in each recording. Bursts of other origin do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calibration import percent
from deal_hw.types import FloatArray

BINS = 16
"""Parts of a joint's travel [-]."""

LEAST_SHARE = 0.5
"""Share of the squared residual that a stretch of the travel must hold [-]."""

DENSER = 2.5
"""Least ratio of that share to the share of the samples there [-]. A model error that is spread over the
motion has about 1."""

CHANNEL_SHARE = 0.8
"""Least share of the squared residual in one channel that is named without a stretch [-]."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a joint's travel that holds most of a residual.

    Attributes:
        low: Its lower end.
        high: Its upper end.
        share: Its share of the squared residual.
        samples: Its share of the samples.
    """

    low: float
    high: float
    share: float
    samples: float


def residual_place(problem: Problem, refined: Refined) -> str:
    """Return in a sentence where the squared residual of a fit lies."""
    power, position = [], []
    for data, residual in zip(refined.shooting.data, refined.normal.residual, strict=True):
        power.append((residual**2).reshape(-1, residual.shape[-1]))
        states = problem.episodes[data.episode].position[data.windows.samples()]
        position.append(states.reshape(-1, states.shape[-1]))
    squared, at = np.concatenate(power), np.concatenate(position)
    of_channel = squared.sum(axis=0) / max(float(squared.sum()), 1e-300)
    worst = int(np.argmax(of_channel))
    most = f"{percent(float(of_channel[worst]))} of its square is in {problem.channel_names[worst]}"
    turns = problem.robot.coordinate_units
    # Samples that filled a gap have a residual of 0.
    seen = squared.any(axis=1)
    found: list[tuple[Stretch, int]] = []
    for c in range(*problem.robot.joints.indices(at.shape[1])):
        folded = turns[c] == "rad" and np.ptp(at[:, c]) > 2 * np.pi
        values = np.mod(at[:, c] + np.pi, 2 * np.pi) - np.pi if folded else at[:, c]
        stretch = densest_stretch(squared.sum(axis=1)[seen], values[seen])
        if stretch is not None:
            found.append((stretch, c))
    if not found:
        return (
            f"{most}." if of_channel[worst] >= CHANNEL_SHARE else "It is spread over channels and positions."
        )
    stretch, c = max(found, key=lambda pair: pair[0].share / pair[0].samples)
    return (
        f"{percent(stretch.share)} of its square lies where {problem.robot.coordinates[c]} is between "
        f"{stretch.low:.2f} and {stretch.high:.2f} {turns[c]}, with {percent(stretch.samples)} of the "
        f"samples; {most}."
    )


def densest_stretch(power: FloatArray, position: FloatArray) -> Stretch | None:
    """Return the shortest stretch of positions, (n,), that holds most of the squared residual, (n,).

    It includes neighbours in which the residual is as dense. None where it holds about as many samples.
    """
    low, high = float(position.min()), float(position.max())
    total = float(power.sum())
    if not (high > low and total > 0):
        return None
    edges = np.linspace(low, high, BINS + 1)
    share = np.histogram(position, edges, weights=power)[0] / total
    samples = np.histogram(position, edges)[0] / len(position)
    dense = share >= DENSER * samples

    def stretch(first: int, end: int) -> Stretch:
        held, there = float(share[first:end].sum()), float(samples[first:end].sum())
        return Stretch(float(edges[first]), float(edges[end]), held, there)

    for width in range(1, BINS):
        every = [stretch(first, first + width) for first in range(BINS - width + 1)]
        enough = [s.share >= max(LEAST_SHARE, DENSER * s.samples) for s in every]
        if any(enough):
            first = int(np.argmax([s.share * good for s, good in zip(every, enough, strict=True)]))
            end = first + width
            # Its neighbours belong to it where the residual is as dense.
            while first > 0 and dense[first - 1]:
                first -= 1
            while end < BINS and dense[end]:
                end += 1
            return stretch(first, end)
    return None
