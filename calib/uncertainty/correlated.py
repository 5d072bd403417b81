"""Which kinds of parameters go with each other: fix one and the other is known, leave both and neither is.

A pair of single parameters hardly shows it: a delay goes with the armatures of all joints together. So whole
kinds are compared.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.types import FloatArray

LATENCY = "latency"
WIDE = 10.0
"""What is not in the data is known to be within so many ranges: hardly. Held to the range itself, a kind that
the data leave open looks known, and what goes with it is not named."""
NARROWER = 1.25
"""Kinds are named where fixing one makes the other's interval narrower by this factor: a third of what is not
known of the one (in variance) is what is not known of the other."""

MOSTLY = 2.0
"""From this factor on, three quarters, they are confounded; below it partly."""


@dataclass(frozen=True, slots=True)
class Confounded:
    """Two kinds of parameters that the data tell apart badly.

    Attributes:
        first: A kind, or ``latency``.
        second: Another kind.
        factor: How much narrower the first's intervals were (the median, element by element), were the second
            known.
    """

    first: str
    second: str
    factor: float

    @property
    def words(self) -> str:
        """In a sentence."""
        degree = "" if self.factor >= MOSTLY else "partly "
        return (
            f"{self.first} and {self.second} are {degree}confounded: with {self.second} known the interval "
            f"of {self.first} would be {self.factor:.1f} times narrower"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {"first": self.first, "second": self.second, "factor": self.factor}


def confounded(problem: Problem, information: FloatArray) -> tuple[Confounded, ...]:
    """Return the confounded pairs of kinds, the worst first.

    Args:
        problem: Says which parameter is of which kind, and the ranges.
        information: What the data say of parameters, in their own scale, and latency, (K + 1, K + 1); without
            any prior.
    """
    space = problem.space
    low, high = problem.latency_range_s
    hardly = 12.0 / (WIDE * np.append(space.width, high - low)) ** 2
    precision = information + np.diag(hardly)
    kinds = {kind: [k for k, p in enumerate(space) if p.kind == kind] for kind in {p.kind for p in space}}
    if problem.fixed_latency_s is None:
        kinds[LATENCY] = [len(space)]
    # Latency first, so that a pair with it is said from its side.
    names = sorted(kinds, key=lambda name: (name != LATENCY, name))
    whole = _std(precision, [i for members in kinds.values() for i in members])
    found = []
    for a, b in itertools.combinations(names, 2):
        without = [i for name, members in kinds.items() if name != b for i in members]
        alone = _std(precision, without)
        factor = float(np.median([whole[i] / alone[i] for i in kinds[a]]))
        if factor >= NARROWER:
            found.append(Confounded(a, b, factor))
    return tuple(sorted(found, key=lambda pair: -pair.factor))


def _std(precision: FloatArray, free: list[int]) -> dict[int, float]:
    """Return standard deviations of the free entries, the others fixed."""
    variance = np.diag(np.linalg.inv(precision[np.ix_(free, free)]))
    return {i: float(np.sqrt(v)) for i, v in zip(free, variance, strict=True)}
