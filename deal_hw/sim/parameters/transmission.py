"""Parameter kinds of elastic transmissions: stiffness, damping and play between a motor and its link.

Two are facts: which side of the transmission the encoder measures, and on which side the joint rubs.

Their equations are in :mod:`deal_hw.sim.laws.transmission`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.parameters.fields import element_id
from deal_hw.sim.parameters.kind import Kind, joint_of, one_dof_joint
from deal_hw.sim.parameters.laws import FRICTION_KINDS, check_integrator
from deal_hw.sim.parameters.one_drive import brakes

TRANSMISSION_STIFFNESS: Final = "transmission_stiffness"
TRANSMISSION_DAMPING: Final = "transmission_damping"
TRANSMISSION_PLAY: Final = "transmission_play"
ENCODER_AT_MOTOR: Final = "encoder_at_motor"
FRICTION_AT_MOTOR: Final = "friction_at_motor"

_EFFORTS = ("effort_gain", "effort_bias", "effort_delay", "effort_noise")


def _elastic(model: Any, actuator: int, name: str) -> None:
    drive_of(model, actuator, name)
    joint = joint_of(model, actuator)
    own = model.joint(joint).name
    one_dof_joint(model, joint, own)
    check_integrator(model, "the torque of a transmission")
    if model.actuator_armature[actuator]:
        raise ConfigurationError(
            f"actuator {name!r} has an armature of its own; write it as that of the joint {own!r}, times the "
            "square of the gear"
        )
    if model.jnt_actfrclimited[joint]:
        raise ConfigurationError(
            f"joint {own!r} limits the effort of several actuators, or of one that carries gravity beside "
            "(actuatorfrcrange, actuatorgravcomp), and a transmission has one motor with a limit of its own; "
            f"write it as forcerange of the actuator {name!r}"
        )
    drives = [a for a in range(model.nu) if joint_of(model, a) == joint and a not in brakes(model)]
    if len(drives) > 1:
        names = ", ".join(repr(model.actuator(a).name) for a in drives)
        raise ConfigurationError(
            f"joint {own!r} has {len(drives)} actuators ({names}), and one transmission has one motor; "
            "write one actuator"
        )


def check_transmissions(model: Any, space: ParameterSpace) -> None:
    """Refuse transmissions without a spring or a rotor, and laws that double theirs.

    Raises:
        ConfigurationError: Such a parameter; the message says what to write instead.
    """
    kinds = {(p.kind, e): p for p in space.parameters for e in p.elements}
    for kind in (TRANSMISSION_DAMPING, TRANSMISSION_PLAY):
        for p in (p for p in space.parameters if p.kind == kind):
            for name in p.elements:
                if (TRANSMISSION_STIFFNESS, name) not in kinds:
                    raise ConfigurationError(
                        f"parameter {p.name!r} ({kind}) is of a spring that {name!r} does not have; add "
                        f"{{kind: {TRANSMISSION_STIFFNESS}, elements: {name}, known: 1e5}} or its value"
                    )
    joints = {
        model.joint(joint_of(model, element_id(model, "actuator", e))).name
        for kind, e in kinds
        if kind == TRANSMISSION_STIFFNESS
    }
    for p in (p for p in space.parameters if p.kind in (ENCODER_AT_MOTOR, FRICTION_AT_MOTOR)):
        _check_place(p, joints)
    for joint in (e for kind, e in kinds if kind == FRICTION_AT_MOTOR):
        for kind in (*FRICTION_KINDS, "dof_friction_creep"):
            if (kind, joint) in kinds:
                raise ConfigurationError(
                    f"parameter {kinds[kind, joint].name!r} ({kind}) is of friction at the link, and that of "
                    f"{joint!r} is at the motor ({kinds[FRICTION_AT_MOTOR, joint].name!r}); leave one out"
                )
    for name in (e for kind, e in kinds if kind == TRANSMISSION_STIFFNESS):
        first = kinds[TRANSMISSION_STIFFNESS, name].name
        if ("servo_play", name) in kinds:
            raise ConfigurationError(
                f"parameter {kinds['servo_play', name].name!r} (servo_play) is a second play of {name!r} "
                f"beside the elastic transmission {first!r}; leave it out: transmission_play is its play"
            )
        joint = model.joint(joint_of(model, element_id(model, "actuator", name)))
        _check_rotor(model, joint, kinds.get(("dof_armature", joint.name)), first)
        for other in _EFFORTS:
            if (other, joint.name) in kinds:
                raise ConfigurationError(
                    f"parameter {kinds[other, joint.name].name!r} ({other}) is of the motor's effort, and "
                    f"the joint {joint.name!r} has the torque of its transmission ({first!r}); leave one out"
                )


def _check_place(p: Parameter, sprung: Collection[str]) -> None:
    if not p.known or p.nominal != 1.0:
        given = f"{p.nominal:g}" if p.known else "searched"
        what = "an encoder" if p.kind == ENCODER_AT_MOTOR else "friction"
        raise ConfigurationError(
            f"parameter {p.name!r} ({p.kind}) is {given}, and the place of {what} is a fact; "
            "write `known: true` where it is at the motor, leave it out where it is at the link"
        )
    for joint in p.elements:
        if joint not in sprung:
            raise ConfigurationError(
                f"parameter {p.name!r} ({p.kind}): {joint!r} has no elastic transmission, so it turns as its "
                f"motor does; add {TRANSMISSION_STIFFNESS} of its actuator, or leave this out"
            )


def _check_rotor(model: Any, joint: Any, armature: Any, spring: str) -> None:
    least = float(np.ravel(model.dof_armature[joint.dofadr[0]])[0])
    if armature is not None:
        least = armature.nominal if armature.known else armature.low
    if least <= 0:
        raise ConfigurationError(
            f"parameter {spring!r}: the rotor of {joint.name!r} needs inertia, and dof_armature is "
            f"{'0 in the model' if armature is None else f'{least:g} at its lowest'}; write "
            'armature="..." into the joint, the rotor\'s inertia times the square of the gear ratio, or '
            "search dof_armature in a range above 0"
        )


TRANSMISSION_KINDS = (
    Kind(
        name=TRANSMISSION_STIFFNESS,
        element="actuator",
        quantity="transmission_stiffness",
        unit="N·m/rad",
        unit_slide="N/m",
        writes=(),
        along="a spring between motor and link; the joint's dof_armature is the motor's, behind it",
        apply=None,
        baseline=None,
        usable=_elastic,
    ),
    Kind(
        name=TRANSMISSION_DAMPING,
        element="actuator",
        quantity="transmission_damping",
        unit="N·m·s/rad",
        unit_slide="N·s/m",
        writes=(),
        along="damping beside that spring, of the difference of their speeds",
        apply=None,
        baseline=None,
        usable=_elastic,
    ),
    Kind(
        name=TRANSMISSION_PLAY,
        element="actuator",
        quantity="transmission_play",
        unit="rad",
        unit_slide="m",
        writes=(),
        along="a gap of this width between motor and link, in which the spring passes nothing",
        apply=None,
        baseline=lambda m, i: 0.0,
        usable=_elastic,
        scale="linear",
        spread=0.05,
    ),
    Kind(
        name=ENCODER_AT_MOTOR,
        element="joint",
        quantity="encoder_at_motor",
        unit="-",
        writes=(),
        along="the reported position is the motor's, before the elastic transmission; `known: true` only",
        apply=None,
        # No MJCF says it: the entry itself does.
        baseline=lambda m, i: 1.0,
        usable=one_dof_joint,
        scale="linear",
    ),
    Kind(
        name=FRICTION_AT_MOTOR,
        element="joint",
        quantity="friction_at_motor",
        unit="-",
        writes=(),
        along="the joint's dry friction and damping act on the motor, before the elastic transmission; "
        "`known: true` only",
        apply=None,
        # As with the encoder.
        baseline=lambda m, i: 1.0,
        usable=one_dof_joint,
        scale="linear",
    ),
)
