"""Parameter kinds of bodies: mass, inertia, centre of mass and length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import Apply, Kind, moving_body

_SHARED_SHAPES = tuple(
    int(t) for t in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
)
_GEOMETRY = (
    "body_pos",
    "geom_pos",
    "geom_size",
    "geom_rbound",
    "geom_aabb",
    "bvh_aabb",
    "site_pos",
    "jnt_pos",
)


def body_mass(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set body masses [kg]; the inertia scales too, as for a body of the same shape and another density.

    The present inertia scales: apply lengths first.
    """
    mass, inertia = fields.get("body_mass"), fields.get("body_inertia")
    for name in elements:
        body = element_id(fields.model, "body", name)
        inertia[:, body] *= (values / mass[:, body])[:, None]
        mass[:, body] = values


def body_inertia(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Scale the inertia about the centre of mass by a factor; mass and centre stay.

    The present inertia scales: apply mass and length first.
    """
    inertia = fields.get("body_inertia")
    for name in elements:
        inertia[:, element_id(fields.model, "body", name)] *= values[:, None]


def _move_centre(axis: int) -> Apply:
    def apply(fields: Fields, elements: Sequence[str], values: Array) -> None:
        ipos = fields.get("body_ipos")
        for name in elements:
            body = element_id(fields.model, "body", name)
            ipos[:, body, axis] += values
            if fields.model.body_sameframe[body]:
                # If centre and origin coincide, the compiler marks this, and the engine then ignores
                # body_ipos.
                fields.get("body_sameframe")[:, body] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)

    return apply


body_ipos_x, body_ipos_y, body_ipos_z = _move_centre(0), _move_centre(1), _move_centre(2)


def rod_length(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the length of thin uniform rods along their body's z axis [m]; centre and inertia change, too.

    For a rod of mass m and length l with one end at the body's origin: centre of mass l / 2, inertia m l^2 /
    12. Geoms keep their size; they have no mass and no contact.
    """
    mass, inertia, ipos = fields.get("body_mass"), fields.get("body_inertia"), fields.get("body_ipos")
    for name in elements:
        body = element_id(fields.model, "body", name)
        ipos[:, body, 2] = np.sign(fields.model.body_ipos[body, 2]) * values / 2
        transverse = mass[:, body] * values**2 / 12
        inertia[:, body, 0] = transverse
        inertia[:, body, 1] = transverse


def body_scale(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Scale a body's geometry by a factor: everything fixed to it, and the origins of its child bodies.

    Positions, sizes and the centre of mass scale; the inertia scales with the square, the mass stays.
    """
    model = fields.model
    for name in elements:
        body = element_id(model, "body", name)
        for field, index in _members(model, body):
            target = fields.get(field)
            for i in index:
                target[:, i] *= values.reshape(-1, *(1,) * (target.ndim - 2))
        fields.get("body_ipos")[:, body] *= values[:, None]
        fields.get("body_inertia")[:, body] *= np.square(values)[:, None]


def _members(model: Any, body: int) -> list[tuple[str, list[int]]]:
    geoms = np.flatnonzero(model.geom_bodyid == body).tolist()
    first = int(model.body_bvhadr[body])
    volumes = list(range(first, first + int(model.body_bvhnum[body]))) if first >= 0 else []
    return [
        ("body_pos", [i for i in range(1, model.nbody) if model.body_parentid[i] == body]),
        ("jnt_pos", np.flatnonzero(model.jnt_bodyid == body).tolist()),
        ("site_pos", np.flatnonzero(model.site_bodyid == body).tolist()),
        *((field, geoms) for field in ("geom_pos", "geom_size", "geom_rbound", "geom_aabb")),
        ("bvh_aabb", volumes),
    ]


def _scalable(model: Any, body: int, name: str) -> None:
    moving_body(model, body, name)
    for geom in np.flatnonzero(model.geom_bodyid == body):
        touches = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if int(model.geom_type[geom]) in _SHARED_SHAPES and touches:
            raise ConfigurationError(
                f"body {name!r} has a contact mesh, whose vertices all simulations share, so its size cannot "
                "differ between them; give it primitives for contact, or use rod_length for a rod"
            )


def movable_centre(model: Any, body: int, name: str) -> None:
    """Refuse bodies whose centre and principal axes the compiler has fixed."""
    moving_body(model, body, name)
    if model.body_simple[body]:
        raise ConfigurationError(
            f"body {name!r} has its centre of mass in its origin and was compiled to a diagonal inertia, so "
            f"neither its centre nor its axes can change; write "
            f'<body name="{name}" simple="false"> in the MJCF'
        )


def _thin_rod(model: Any, body: int, name: str) -> None:
    moving_body(model, body, name)
    mass, inertia, ipos = model.body_mass[body], model.body_inertia[body], model.body_ipos[body]
    length = 2 * abs(ipos[2])
    if not (length > 0 and np.allclose(inertia[:2], mass * length**2 / 12, rtol=0.05)):
        raise ConfigurationError(
            f"body {name!r} is not a thin uniform rod along z from its origin (centre {ipos.tolist()} m, "
            f"inertia {inertia.tolist()} kg·m²); use body_scale for other shapes"
        )


BODY_KINDS = (
    Kind(
        name="rod_length",
        element="body",
        quantity="length",
        unit="m",
        writes=("body_ipos", "body_inertia"),
        along="centre of mass l / 2, inertia m l² / 12",
        apply=rod_length,
        baseline=lambda m, i: 2 * abs(float(m.body_ipos[i, 2])),
        usable=_thin_rod,
        order=0,
        relative=True,
    ),
    Kind(
        name="body_scale",
        element="body",
        quantity="scale",
        unit="-",
        writes=("body_ipos", "body_inertia", *_GEOMETRY),
        along="child bodies' origins, geoms, sites, joint anchors, centre of mass; inertia with the square",
        apply=body_scale,
        baseline=lambda m, i: 1.0,
        usable=_scalable,
        order=0,
        relative=True,
    ),
    Kind(
        name="body_mass",
        element="body",
        quantity="mass",
        unit="kg",
        writes=("body_mass", "body_inertia"),
        along="inertia in proportion",
        apply=body_mass,
        baseline=lambda m, i: float(m.body_mass[i]),
        usable=moving_body,
        order=1,
        relative=True,
    ),
    Kind(
        name="body_inertia",
        element="body",
        quantity="inertia",
        unit="-",
        writes=("body_inertia",),
        along="nothing; a factor on what mass and length give",
        apply=body_inertia,
        baseline=lambda m, i: 1.0,
        usable=moving_body,
        relative=True,
    ),
    *(
        Kind(
            name=f"body_ipos_{axis}",
            element="body",
            quantity=f"ipos_{axis}",
            unit="m",
            writes=("body_ipos",),
            along="nothing; an offset of the centre of mass in the body's frame",
            apply=apply,
            baseline=lambda m, i: 0.0,
            usable=movable_centre,
            scale="linear",
            spread=0.02,
            least=float("-inf"),
            relative=True,
        )
        for axis, apply in (("x", body_ipos_x), ("y", body_ipos_y), ("z", body_ipos_z))
    ),
)
