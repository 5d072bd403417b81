"""Sets of kinds that one entry of params.yaml names together: `inertial`, the ten of a body.

Each parameter of a set expects the model's value, with the usual accuracy of CAD data as standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from deal_hw.sim.parameters.inertia import SHEARS, STRETCHES


@dataclass(frozen=True, slots=True)
class SetPart:
    """Part of a set: kinds of one unit, which share a prior.

    Attributes:
        kinds: The kinds.
        prior_std: Usual accuracy of CAD data: a share of the value on a log scale, else in the unit.
        reach: Half width of the range: a factor on a log scale, else in the unit.
    """

    kinds: tuple[str, ...]
    prior_std: float
    reach: float


INERTIAL: Final = "inertial"

KIND_SETS: Final[Mapping[str, Mapping[str, SetPart]]] = MappingProxyType(
    {
        INERTIAL: MappingProxyType(
            {
                "mass": SetPart(("body_mass",), 0.1, 2.0),
                "com": SetPart(("body_ipos_x", "body_ipos_y", "body_ipos_z"), 0.005, 0.05),
                "stretch": SetPart(STRETCHES, 0.1, 2.0),
                "shear": SetPart(tuple(SHEARS), 0.1, 0.5),
            }
        )
    }
)
"""Parts of each set by their names in `prior`.

The accuracies are those of links whose cables, screws and batteries are not in the CAD model.
"""
