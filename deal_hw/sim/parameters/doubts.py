"""How wrong a model's values usually are: the prior of a value of which its owner says nothing.

Published pairs of models and identified values are rare, and most compare two fits. So the widths are rather
too wide than too narrow: such a prior only has to hold what recordings do not show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True, slots=True)
class Doubt:
    """The usual error of a model's value.

    Attributes:
        std: Standard deviation: of ln(true / model) for a kind on a log scale, else in its unit.
        source: Where it comes from.
    """

    std: float
    source: str


DOUBTS: Final[Mapping[str, Doubt]] = MappingProxyType(
    {
        "body_mass": Doubt(
            0.3,
            "our judgement: CAD gives 0.1; two identifications of the links of a Franka arm differ by 0.7",
        ),
        "dof_frictionloss": Doubt(1.5, "five published models of one SO-101 arm against its MJCF: 1.8"),
        "dof_damping": Doubt(1.0, "fits of a Go2's legs (1.0) and of an SO-101 arm (1.5) against their MJCF"),
        "dof_armature": Doubt(0.8, "fits of a Go2's and a G1's joints against one value for all: 0.74"),
        "servo_stiffness": Doubt(0.8, "five published models of one SO-101 arm: 0.9"),
        "servo_damping": Doubt(1.0, "as a joint's damping, to which it adds"),
        "servo_effort_limit": Doubt(
            0.25, "stall torque of a hobby servo on a lever against its data sheet; URDFs of a Go1"
        ),
        "motor_gain": Doubt(
            0.8, "our judgement: data sheets give 0.1 for a torque constant, but not what a command of 1 is"
        ),
        "encoder_bias": Doubt(
            0.02, "frames of a TIAGo arm found by calibration: 0.020 rad; arms homed by hand: up to 0.3 rad"
        ),
    }
)
"""By kind. What is not here is no doubt of most owners."""
