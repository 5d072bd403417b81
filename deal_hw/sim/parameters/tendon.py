"""Parameter kinds of tendons: friction that changes with position, by the tendon's moment arm.

The moment arm of a rod or belt in a linkage depends on the joint's position, and so does its friction at the
joint. MuJoCo's own dry friction of a joint is constant; that of a spatial tendon is force times moment arm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import FRICTION_RATIO, Kind


def _set(fields: Fields, field: str, elements: Sequence[str], values: Array) -> None:
    column = fields.get(field)
    for name in elements:
        column[:, element_id(fields.model, "tendon", name)] = values


def tendon_frictionloss(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set dry friction along a tendon [N; N·m/rad where a fixed tendon combines hinges]."""
    _set(fields, "tendon_frictionloss", elements, values)


def tendon_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set viscous damping along a tendon [N·s/m]."""
    _set(fields, "tendon_damping", elements, values)


TENDON_KINDS = (
    Kind(
        name="tendon_frictionloss",
        element="tendon",
        quantity="frictionloss",
        unit="N",
        writes=("tendon_frictionloss",),
        along="nothing",
        apply=tendon_frictionloss,
        baseline=lambda m, i: float(m.tendon_frictionloss[i]),
        ratio=FRICTION_RATIO,
    ),
    Kind(
        name="tendon_damping",
        element="tendon",
        quantity="damping",
        unit="N·s/m",
        writes=("tendon_damping",),
        along="nothing",
        apply=tendon_damping,
        baseline=lambda m, i: float(np.ravel(m.tendon_damping[i])[0]),
    ),
)
