"""Parameter kinds of joints: armature, viscous damping and dry friction of each degree of freedom."""

from __future__ import annotations

from collections.abc import Sequence

from deal_hw.sim.fields import Array, Fields, element_id


def _set_dof(fields: Fields, field: str, elements: Sequence[str], values: Array) -> None:
    target = fields.get(field)
    for name in elements:
        joint = element_id(fields.model, "joint", name)
        # Fields of degrees of freedom are (N, nv) or, for polynomial coefficients, (N, nv, n): the first is
        # the linear one.
        column = target[:, fields.model.jnt_dofadr[joint]]
        if column.ndim == 1:
            column[:] = values
        else:
            column[:, 0] = values


def dof_armature(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the rotor inertia seen at the joint [kg·m² or kg]."""
    _set_dof(fields, "dof_armature", elements, values)


def dof_damping(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set viscous damping [N·m·s/rad or N·s/m]."""
    _set_dof(fields, "dof_damping", elements, values)


def dof_frictionloss(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set dry friction [N·m or N]."""
    _set_dof(fields, "dof_frictionloss", elements, values)
