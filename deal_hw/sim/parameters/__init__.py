"""Parameter kinds: how a physical parameter changes a MuJoCo model, one small function each.

A kind is ``apply(fields, elements, values)``: it writes ``values`` (N,) for the named elements into the
fields of N simulations. The table :data:`KINDS` is explicit; new kinds are added here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from deal_hw.errors import UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.fields import Array, Fields
from deal_hw.sim.parameters.actuator import servo_damping, servo_effort_limit, servo_stiffness
from deal_hw.sim.parameters.body import body_mass, rod_length
from deal_hw.sim.parameters.joint import dof_armature, dof_damping, dof_frictionloss

Apply = Callable[[Fields, Sequence[str], Array], None]

KINDS: Mapping[str, Apply] = {
    "body_mass": body_mass,
    "rod_length": rod_length,
    "dof_armature": dof_armature,
    "dof_damping": dof_damping,
    "dof_frictionloss": dof_frictionloss,
    "servo_stiffness": servo_stiffness,
    "servo_damping": servo_damping,
    "servo_effort_limit": servo_effort_limit,
}
DEVICE_KINDS = ("servo_speed_limit",)
"""Kinds that no MuJoCo field holds: the set-point generator in front of the actuator applies them."""

SERVO_KINDS = ("servo_stiffness", "servo_damping", "servo_effort_limit", "servo_speed_limit")
"""Kinds that scale with what the robot was sent."""

ORDER = ("rod_length", "body_mass")
"""Kinds that must be applied first, in this order: mass scales the inertia that a length has set."""


def check_kinds(space: ParameterSpace) -> None:
    """Check that every parameter is of a known kind.

    Raises:
        UnknownNameError: One is not; the message lists the kinds.
    """
    for parameter in space.parameters:
        if parameter.kind not in KINDS and parameter.kind not in DEVICE_KINDS:
            raise UnknownNameError("parameter kind", parameter.kind, (*KINDS, *DEVICE_KINDS))


def apply_parameters(fields: Fields, space: ParameterSpace, theta: Array) -> None:
    """Write free parameters (N, K), and the known ones, into the fields of N simulations.

    Args:
        fields: Where to write.
        space: The parameters.
        theta: Physical values of the free parameters, (N, K).
    """
    check_kinds(space)
    count = theta.shape[0]
    columns = {name: theta[:, k] for k, name in enumerate(space.names)}
    ranked = sorted(space.parameters, key=lambda p: ORDER.index(p.kind) if p.kind in ORDER else len(ORDER))
    for parameter in ranked:
        if parameter.kind in DEVICE_KINDS:
            continue
        values = columns.get(parameter.name)
        if values is None:
            values = np.full(count, parameter.nominal)
        KINDS[parameter.kind](fields, parameter.elements, values)
