"""Parameter kinds of bodies: mass and length."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deal_hw.sim.fields import Array, Fields, element_id


def body_mass(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set body masses [kg]; the inertia scales along, as for a body of the same shape and another density.

    The inertia that scales is the one at hand: apply lengths first.
    """
    mass, inertia = fields.get("body_mass"), fields.get("body_inertia")
    for name in elements:
        body = element_id(fields.model, "body", name)
        inertia[:, body] *= (values / mass[:, body])[:, None]
        mass[:, body] = values


def rod_length(fields: Fields, elements: Sequence[str], values: Array) -> None:
    """Set the length of thin uniform rods along their body's z axis [m]; centre and inertia move along.

    For a rod of mass m and length l with one end at the body's origin: centre of mass l / 2, inertia m l^2 /
    12. Drawn geoms keep their size; they have no mass and no contact.
    """
    mass, inertia, ipos = fields.get("body_mass"), fields.get("body_inertia"), fields.get("body_ipos")
    for name in elements:
        body = element_id(fields.model, "body", name)
        ipos[:, body, 2] = np.sign(fields.model.body_ipos[body, 2]) * values / 2
        transverse = mass[:, body] * values**2 / 12
        inertia[:, body, 0] = transverse
        inertia[:, body, 1] = transverse
