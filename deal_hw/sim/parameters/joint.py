"""Parameter kinds of joints: armature, viscous damping, dry friction and its creep, springs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import DAMPING_RATIO, FRICTION_RATIO, Kind, one_dof_joint


def _set(fields: Fields, field: str, index: int, values: Array) -> None:
    # Fields may be (N, n) or, for polynomial coefficients, (N, n, k), whose first one is linear.
    column = fields.get(field)[:, index]
    if column.ndim == 1:
        column[:] = values
    else:
        column[:, 0] = values


def _set_dof(fields: Fields, field: str, elements: Sequence[str], values: Array) -> None:
    for name in elements:
        joint = element_id(fields.model, "joint", name)
        _set(fields, field, int(fields.model.jnt_dofadr[joint]), values)


def dof_armature(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the rotor inertia seen at the joint [kg·m² or kg]."""
    _set_dof(fields, "dof_armature", elements, values)


def dof_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set viscous damping [N·m·s/rad or N·s/m]."""
    _set_dof(fields, "dof_damping", elements, values)


def dof_dampingpoly_square(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the coefficient c of damping quadratic in speed [N·m·s²/rad² or N·s²/m²]: opposing torque c v²."""
    _set_poly(fields, elements, values, 0)


def dof_dampingpoly_cube(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the coefficient c of damping cubic in speed [N·m·s³/rad³ or N·s³/m³]: opposing torque c |v|³."""
    _set_poly(fields, elements, values, 1)


def _set_poly(fields: Fields, elements: Sequence[str], values: Array, power: int) -> None:
    poly = fields.get("dof_dampingpoly")
    for name in elements:
        poly[:, fields.model.jnt_dofadr[element_id(fields.model, "joint", name)], power] = values


def dof_frictionloss(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set dry friction [N·m or N]."""
    _set_dof(fields, "dof_frictionloss", elements, values)


def dof_friction_creep(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the creep under load of a joint held by dry friction: 1 minus the constraint's impedance.

    MuJoCo's friction is a soft constraint of impedance d, ``solimpfriction`` in the MJCF, 0.9 by default.
    Under a load f the joint creeps with the speed ``f A (1 - d) / d / b`` (MuJoCo documentation, Computation:
    Constraint model). A is the inverse inertia at the joint and b = 2 / (dmax timeconst) of its solref. So
    the speed falls in proportion to the value set here. MuJoCo keeps d between 0.0001 and 0.9999.
    """
    solimp = fields.get("dof_solimp")
    for name in elements:
        dof = int(fields.model.jnt_dofadr[element_id(fields.model, "joint", name)])
        solimp[:, dof, 0] = 1 - values
        # Friction has no depth, so dmin alone is its impedance; dmax must not be smaller.
        solimp[:, dof, 1] = np.maximum(1 - values, fields.model.dof_solimp[dof, 1])


def joint_stiffness(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the stiffness of the spring in a joint [N·m/rad or N/m]."""
    for name in elements:
        _set(fields, "jnt_stiffness", element_id(fields.model, "joint", name), values)


def joint_springref(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the position at which the spring in a joint is at rest [rad or m]."""
    spring = fields.get("qpos_spring")
    for name in elements:
        spring[:, fields.model.jnt_qposadr[element_id(fields.model, "joint", name)]] = values


def _dof_value(model: Any, field: str, joint: int) -> float:
    return float(np.ravel(getattr(model, field)[model.jnt_dofadr[joint]])[0])


def _damping_poly(model: Any, joint: int, power: int) -> float:
    return float(model.dof_dampingpoly[model.jnt_dofadr[joint], power])


JOINT_KINDS = (
    Kind(
        name="dof_armature",
        element="joint",
        quantity="armature",
        unit="kg·m²",
        unit_slide="kg",
        writes=("dof_armature",),
        along="nothing",
        apply=dof_armature,
        baseline=lambda m, i: _dof_value(m, "dof_armature", i),
        usable=one_dof_joint,
    ),
    Kind(
        name="dof_damping",
        element="joint",
        quantity="damping",
        unit="N·m·s/rad",
        unit_slide="N·s/m",
        writes=("dof_damping",),
        along="nothing; a servo's D gain adds to it",
        apply=dof_damping,
        baseline=lambda m, i: _dof_value(m, "dof_damping", i),
        usable=one_dof_joint,
        ratio=DAMPING_RATIO,
    ),
    Kind(
        name="dof_dampingpoly_square",
        element="joint",
        quantity="damping_square",
        unit="N·m·s²/rad²",
        unit_slide="N·s²/m²",
        writes=("dof_dampingpoly",),
        along="nothing; dof_damping stays",
        apply=dof_dampingpoly_square,
        baseline=lambda m, i: _damping_poly(m, i, 0),
        usable=one_dof_joint,
        scale="linear",
        spread=0.5,
        least=float("-inf"),
    ),
    Kind(
        name="dof_dampingpoly_cube",
        element="joint",
        quantity="damping_cube",
        unit="N·m·s³/rad³",
        unit_slide="N·s³/m³",
        writes=("dof_dampingpoly",),
        along="nothing; dof_damping stays",
        apply=dof_dampingpoly_cube,
        baseline=lambda m, i: _damping_poly(m, i, 1),
        usable=one_dof_joint,
        scale="linear",
        spread=0.2,
        least=float("-inf"),
    ),
    Kind(
        name="dof_frictionloss",
        element="joint",
        quantity="frictionloss",
        unit="N·m",
        unit_slide="N",
        writes=("dof_frictionloss",),
        along="nothing",
        apply=dof_frictionloss,
        baseline=lambda m, i: _dof_value(m, "dof_frictionloss", i),
        usable=one_dof_joint,
        ratio=FRICTION_RATIO,
    ),
    Kind(
        name="dof_friction_creep",
        element="joint",
        quantity="friction_creep",
        unit="-",
        writes=("dof_solimp",),
        along="dmax of solimpfriction where dmin passes it",
        apply=dof_friction_creep,
        baseline=lambda m, i: 1 - float(m.dof_solimp[m.jnt_dofadr[i], 0]),
        usable=one_dof_joint,
        least=1e-4,
        most=0.9999,
    ),
    Kind(
        name="joint_stiffness",
        element="joint",
        quantity="spring_stiffness",
        unit="N·m/rad",
        unit_slide="N/m",
        writes=("jnt_stiffness",),
        along="nothing",
        apply=joint_stiffness,
        baseline=lambda m, i: float(np.ravel(m.jnt_stiffness[i])[0]),
        usable=one_dof_joint,
    ),
    Kind(
        name="joint_springref",
        element="joint",
        quantity="springref",
        unit="rad",
        unit_slide="m",
        writes=("qpos_spring",),
        along="nothing",
        apply=joint_springref,
        baseline=lambda m, i: float(m.qpos_spring[m.jnt_qposadr[i]]),
        usable=one_dof_joint,
        scale="linear",
        spread=0.2,
        least=float("-inf"),
    ),
)
