"""Values of parameters by kind and element, for code outside MuJoCo that applies them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray

KindValues: TypeAlias = Mapping[str, Sequence[tuple[str, FloatArray]]]
"""For each kind that has one: its elements, and their values in N members, (N,) each."""


def values_by_kind(space: ParameterSpace, theta: FloatArray) -> KindValues:
    """Return the values of all parameters, for those of the free ones, (N, K)."""
    columns = {name: theta[:, k] for k, name in enumerate(space.names)}
    found: dict[str, list[tuple[str, FloatArray]]] = {}
    for p in space.parameters:
        values = columns.get(p.name, np.full(len(theta), p.nominal))
        for element in p.elements:
            found.setdefault(p.kind, []).append((element, values))
    return found


def spread(
    found: KindValues, kind: str, names: Sequence[str], neutral: float, count: int
) -> FloatArray | None:
    """Return a kind's values at all elements, (N, E); None where no element has one.

    Args:
        found: The values.
        kind: The kind.
        names: Names of the elements, E of them.
        neutral: Value of an element that has none.
        count: Members N.
    """
    if kind not in found:
        return None
    every = np.full((count, len(names)), neutral)
    for element, values in found[kind]:
        every[:, names.index(element)] = values
    return every
