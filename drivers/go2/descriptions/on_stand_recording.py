"""Facts about the Unitree Go2 with its base on a stand, as in the public recording of iit-DLSLab.

Twelve joints follow set-points at 200 Hz; no floor, no contact, a base that does not move.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from deal_hw.description import RobotDescription
from deal_hw.drivers.go2.descriptions import floor
from deal_hw.drivers.unitree.spaces import Groups, each, joint_space
from deal_hw.parameters import Parameter, ParameterSpace

STIFFNESS_NM_RAD: Final = 20.0
DAMPING_NMS_RAD: Final = 1.5
JOINT_DAMPING_NMS_RAD: Final = 0.6
FRICTIONLOSS_NM: Final = 0.2
ARMATURE_KGM2: Final = 0.01
ENCODER_BIAS_RAD: Final = 0.1
LINE_FRICTIONLOSS_N: Final = 5.0
"""Largest friction of a knee's rod or strap [N]."""
KNEE_FRICTIONLOSS_NM: Final = (0.02, 4.0)
"""Range of the calves' friction if the rods have friction of their own."""

DESCRIPTION: Final[RobotDescription] = dataclasses.replace(
    floor.DESCRIPTION,
    name="go2_suspended",
    stiffness=(STIFFNESS_NM_RAD,) * 12,
    damping=(DAMPING_NMS_RAD,) * 12,
    control_rate_hz=200.0,
    device_rate_hz=400.0,
    state_rate_hz=200.0,
    mjcf=Path(__file__).parents[1] / "assets" / "go2_suspended.xml",
    floating_base=None,
    sources={
        **floor.DESCRIPTION.sources,
        "stiffness": "configuration of iit-DLSLab/sim2real-robot-identification: kp 20",
        "damping": "the same: kd 1.5",
        "control_rate_hz": "sampling rate of that project's recording",
        "device_rate_hz": "twice that; the motor's own rate is higher and not published",
        "state_rate_hz": "sampling rate of that project's recording",
    },
)


def _space(groups: Groups, *, bias: Sequence[str] = ()) -> ParameterSpace:
    count = len(groups)
    return joint_space(
        groups,
        stiffness=(STIFFNESS_NM_RAD,) * count,
        damping=(DAMPING_NMS_RAD + JOINT_DAMPING_NMS_RAD,) * count,
        frictionloss=(FRICTIONLOSS_NM,) * count,
        armature=(ARMATURE_KGM2,) * count,
        bias=bias,
        bias_rad=ENCODER_BIAS_RAD,
    )


_EACH: Final = each(floor.JOINTS)


def parameter_space() -> ParameterSpace:
    """Return 48 parameters: stiffness, damping, frictionloss and armature of each joint.

    Damping is the damping at the joint for kd = 1.5: the sum of the motor's and of the joint's viscous
    friction (0.6 in the source's model). No recording determines the two alone. This recording hardly
    separates delay and armature: read both with the report's correlation.
    """
    return _space(_EACH)


def biased_space() -> ParameterSpace:
    """Return the 48 parameters and an encoder bias of each joint, 60 in all."""
    return _space(_EACH, bias=floor.JOINTS)


def shared_space() -> ParameterSpace:
    """Return 12 parameters: the same four, shared by the four hips, the four thighs and the four calves."""
    return _space(floor.by_part())


def linkage_space() -> ParameterSpace:
    """Return the 48 parameters, calf friction up to 4 N·m, and that of the knees' rods and straps, 56 in all.

    A rod's friction makes its knee's friction grow as the knee flexes; a strap's grows to both ends of the
    travel. In the model both are 0.
    """
    low, high = KNEE_FRICTIONLOSS_NM
    parameters = [
        dataclasses.replace(p, low=low, high=high) if p.name.endswith("calf_joint.frictionloss") else p
        for p in parameter_space()
    ]
    parameters += [
        Parameter.around(
            f"{leg}_calf_{line}.frictionloss",
            "tendon_frictionloss",
            (f"{leg}_calf_{line}",),
            "N",
            LINE_FRICTIONLOSS_N,
            ratio=10.0,
        )
        for line in ("rod", "strap")
        for leg in floor.LEGS
    ]
    return ParameterSpace(parameters)


def laws_space() -> ParameterSpace:
    """Return the 12 shared parameters, and shared laws of friction by speed and by load, 21 in all."""
    return shared_space().with_friction_laws(floor.by_part(), FRICTIONLOSS_NM)


SPACES: Final = {
    "default": parameter_space,
    "biased": biased_space,
    "shared": shared_space,
    "linkage": linkage_space,
    "laws": laws_space,
}
"""Parameter sets by name; the first is the default of ``deal-hw calibrate``."""
