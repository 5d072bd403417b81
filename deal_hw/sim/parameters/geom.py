"""Parameter kinds of contacts: sliding friction and restitution of a geom.

A contact has two geoms, and MuJoCo mixes their values. The geom of higher ``priority`` decides alone. At
equal priority the larger friction counts, and solref is a weighted mean. So a geom's value acts unchanged
only if no partner of equal or higher priority overrides it; :func:`check_partners` checks that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.sim.parameters.fields import Array, Fields, element_id, element_names
from deal_hw.sim.parameters.kind import Kind, touching_geom

MOST_RESTITUTION = 0.99


def geom_friction(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the sliding friction coefficient; torsional and rolling friction stay."""
    friction = fields.get("geom_friction")
    for name in elements:
        friction[:, element_id(fields.model, "geom", name), 0] = values


def damping_ratio(restitution: Array) -> Array:
    """Return the damping ratio of a spring-damper with these coefficients of restitution, (N,).

    A linear spring-damper of damping ratio z returns after half a period with the share e = exp(-pi z /
    sqrt(1 - z^2)) of its speed; solved for z. It falls from 1 at e = 0 to 0 at e = 1. That is the usual
    textbook formula, for a spring that can also pull; see :func:`bounce` for a real contact.
    """
    log = np.log(np.clip(restitution, 1e-9, MOST_RESTITUTION))
    return np.asarray(-log / np.hypot(np.pi, log))


def bounce(ratio: float) -> float:
    """Return the share of its approach speed with which a body leaves a contact of this damping ratio.

    A contact cannot pull, so it ends when its force does, before the half period is over: exp(-2 z acos(z) /
    sqrt(1 - z^2)), and with hyperbolic functions above z = 1 (Schwager and Pöschel, Granular Matter 9, 2007,
    written with z). A restitution of 0.9, 0.6, 0.3, 0.1, 0 bounces with 0.90, 0.63, 0.40, 0.25, 0.14.
    """
    if math.isclose(ratio, 1.0):
        return math.exp(-2.0)
    if ratio < 1:
        return math.exp(-2 * ratio * math.acos(ratio) / math.sqrt(1 - ratio**2))
    return math.exp(-2 * ratio * math.acosh(ratio) / math.sqrt(ratio**2 - 1))


def restitution_of(ratio: float) -> float:
    """Return the coefficient of restitution of a damping ratio: the inverse of :func:`damping_ratio`."""
    return float(np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2))) if ratio < 1 else 0.0


def geom_restitution(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the coefficient of restitution, through solref, as MuJoCo has none.

    Contacts are spring-dampers ``solref = (timeconst, dampratio)``. The damping ratio follows from the
    restitution (:func:`damping_ratio`). The time constant changes with it, so that the contact's frequency
    1 / (timeconst dampratio), and with it its stiffness, stays the model's. Low values bounce higher than
    they state (:func:`bounce`): a contact that hardly bounces needs more damping than the integrator's step
    allows.
    """
    solref = fields.get("geom_solref")
    ratio = damping_ratio(values)
    for name in elements:
        geom = element_id(fields.model, "geom", name)
        timeconst, nominal = fields.model.geom_solref[geom]
        solref[:, geom, 0] = timeconst * nominal / ratio
        solref[:, geom, 1] = ratio


def check_partners(model: Any, kind: str, elements: Sequence[str], low: float) -> None:
    """Check that the values of these geoms decide their contacts.

    Args:
        model: The MjModel.
        kind: "geom_friction" or "geom_restitution".
        elements: The geoms that change together.
        low: Lowest value of the range.

    Raises:
        ConfigurationError: A partner overrides them; the message names it.
    """
    names = element_names(model, "geom")
    chosen = {element_id(model, "geom", name) for name in elements}
    for a in chosen:
        for b in range(model.ngeom):
            if b in chosen or not _touch(model, a, b) or model.geom_priority[a] > model.geom_priority[b]:
                continue
            higher = model.geom_priority[b] > model.geom_priority[a]
            if higher or kind == "geom_restitution" or model.geom_friction[b, 0] > low:
                raise ConfigurationError(
                    f"{kind} of geom {names[a]!r} is overridden by geom {names[b] or b!r}, which it touches "
                    "(MuJoCo takes the larger friction, mixes solref, and prefers the higher priority); name "
                    f"both geoms together, or give {names[a]!r} the higher priority in the MJCF"
                )


def _touch(model: Any, a: int, b: int) -> bool:
    if model.body_weldid[model.geom_bodyid[a]] == model.body_weldid[model.geom_bodyid[b]]:
        return False
    return bool(
        model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]
    )


def _standard_solref(model: Any, geom: int, name: str) -> None:
    touching_geom(model, geom, name)
    if np.any(model.geom_solref[geom] <= 0):
        raise ConfigurationError(
            f"geom {name!r} gives stiffness and damping directly (negative solref); restitution needs "
            "solref as time constant and damping ratio: write it that way in the MJCF"
        )


GEOM_KINDS = (
    Kind(
        name="geom_friction",
        element="geom",
        quantity="friction",
        unit="-",
        writes=("geom_friction",),
        along="nothing; torsional and rolling friction stay",
        apply=geom_friction,
        baseline=lambda m, i: float(m.geom_friction[i, 0]),
        usable=touching_geom,
    ),
    Kind(
        name="geom_restitution",
        element="geom",
        quantity="restitution",
        unit="-",
        writes=("geom_solref",),
        along="time constant: the contact's frequency stays",
        apply=geom_restitution,
        baseline=lambda m, i: restitution_of(float(m.geom_solref[i, 1])),
        usable=_standard_solref,
        most=MOST_RESTITUTION,
    ),
)
