"""Parameter kinds of a whole inertia: how a body's mass is distributed, always physically possible.

A body's ten inertial parameters are its mass m, its centre of mass c (3) and its inertia about c (6). The six
kinds here are the shape of the last: the body's mass distribution is deformed by x -> A x about its centre,
with A upper triangular and a positive diagonal:

        | stretch_1  shear_12   shear_13 |
    A = |    0       stretch_2  shear_23 |,    S = A S0 A^T,    I = tr(S) 1 - S.
        |    0          0       stretch_3|

S is the second moment of mass about the centre, (3, 3) [kg·m²], and S0 that of the model; the axes are the
model's principal ones, axis 1 that of the largest moment of inertia (the thinnest direction) and axis 3 that
of the smallest (the longest). Every S of a body with volume has exactly one such A, and S is positive
semidefinite for every A. So no value is impossible: the triangle inequality of principal moments holds
throughout. Together with `body_mass` and `body_ipos_*` this is the log-Cholesky form of the pseudo-inertia
(Rucker and Wensing, "Smooth Parameterization of Rigid-Body Inertia", RA-L 2022), with the body of the model
as reference, so that all values of the model are 1 or 0, also of plates and rods without thickness.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
import scipy

from deal_hw.sim.parameters.body import movable_centre
from deal_hw.sim.parameters.fields import Array, Fields, element_id
from deal_hw.sim.parameters.kind import Apply, Kind

STRETCHES: Final = ("body_stretch_1", "body_stretch_2", "body_stretch_3")
SHEARS: Final[Mapping[str, tuple[int, int]]] = {
    "body_shear_12": (0, 1),
    "body_shear_13": (0, 2),
    "body_shear_23": (1, 2),
}
"""Row and column of each shear in A."""

STRETCH_RATIO = 2.0
SHEAR_SPREAD = 0.5


def shape(fields: Fields, element: str, values: Mapping[str, Array]) -> None:
    """Deform the mass distribution of one body about its centre; mass and centre stay.

    The present inertia is deformed: apply mass and length first.

    Args:
        fields: The fields of N simulations.
        element: The body.
        values: The shape kinds that are set, (N,) each; the others do nothing.
    """
    body = element_id(fields.model, "body", element)
    inertia = fields.get("body_inertia")
    order = _thinnest_first(np.asarray(fields.model.body_inertia[body]))
    moment = _second_moment(inertia[:, body])[:, order]
    A = np.zeros((len(inertia), 3, 3))
    for i, name in enumerate(STRETCHES):
        A[:, i, i] = values.get(name, 1.0)
    for name, (row, column) in SHEARS.items():
        A[:, row, column] = values.get(name, 0.0)
    S = np.einsum("nij,nj,nkj->nik", A, moment, A)
    upright = ~np.any([values[name] for name in SHEARS if name in values] or [np.zeros(1)], axis=0)
    # Without shear the axes stay; a decomposition would only rename them.
    straight = np.empty_like(moment)
    straight[:, order] = np.einsum("nii->ni", S)
    turned, axes = _principal(S)
    moments = np.where(upright[:, None], straight, turned)
    inertia[:, body] = moments.sum(axis=1, keepdims=True) - moments
    if upright.all():
        return
    # Columns: the new axes in the body's frame, where those of the model are the rotation of its iquat.
    frame = np.eye(3)[:, order]
    if np.linalg.det(frame) < 0:
        # Moments of mass have no sign, but a frame must be right-handed: both turn the same axis around.
        axes = axes * np.array([1.0, 1.0, -1.0])
    # Loaded on use: it takes longer than all else that an emulator imports.
    rotation = scipy.spatial.transform.Rotation
    nominal = rotation.from_quat(fields.model.body_iquat[body], scalar_first=True)
    found = nominal * rotation.from_matrix(frame @ axes)
    quat = fields.get("body_iquat")
    quat[:, body] = np.where(
        upright[:, None], fields.model.body_iquat[body], found.as_quat(scalar_first=True, canonical=True)
    )
    if fields.model.body_sameframe[body]:
        # The compiler marks a frame that is the body's own, and the engine then ignores body_iquat.
        fields.get("body_sameframe")[:, body] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)


def _second_moment(inertia: Array) -> Array:
    """Return the principal second moments of mass of principal moments of inertia, (..., 3) [kg·m²]."""
    # Rounding of the compiler may leave a plate a moment below 0.
    return np.asarray(np.maximum(inertia.sum(axis=-1, keepdims=True) / 2 - inertia, 0.0))


def _thinnest_first(inertia: Array) -> list[int]:
    order: list[int] = np.argsort(_second_moment(inertia), kind="stable").tolist()
    return order


def _principal(S: Array) -> tuple[Array, Array]:
    """Return principal values, (N, 3), ascending, and right-handed axes as columns, (N, 3, 3)."""
    values, axes = np.linalg.eigh(S)
    # Axes near those of the model: none turns by half a revolution for nothing.
    axes = axes * np.where(np.einsum("nii->ni", axes) < 0, -1.0, 1.0)[:, None]
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return np.maximum(values, 0.0), axes


def _alone(name: str) -> Apply:
    def apply(fields: Fields, elements: Sequence[str], values: Array) -> None:
        for element in elements:
            shape(fields, element, {name: values})

    return apply


def _kind(name: str, **more: Any) -> Kind:
    return Kind(
        name=name,
        element="body",
        quantity=name.removeprefix("body_"),
        unit="-",
        writes=("body_inertia", "body_iquat"),
        apply=_alone(name),
        usable=movable_centre,
        together=shape,
        excludes=("body_inertia", "rod_length"),
        relative=True,
        order=3,
        **more,
    )


INERTIA_KINDS = (
    *(
        _kind(
            name,
            along="nothing; a factor on the body's extent along this principal axis",
            baseline=lambda m, i: 1.0,
            ratio=STRETCH_RATIO,
        )
        for name in STRETCHES
    ),
    *(
        _kind(
            name,
            along="nothing; a tilt of the second axis towards the first",
            baseline=lambda m, i: 0.0,
            scale="linear",
            spread=SHEAR_SPREAD,
            least=float("-inf"),
        )
        for name in SHEARS
    ),
)
