"""The mechanics of an emulated cart-pole: the MJCF with other parameters."""

from __future__ import annotations

from collections.abc import Mapping

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.sim.engine.single import SingleSimulation


def build_simulation(parameters: Mapping[str, float]) -> SingleSimulation:
    """Return the mechanics with these parameters, named as in ``parameter_space()``."""
    sim = SingleSimulation(DESCRIPTION.mjcf)
    sim.set_body_mass("cart", parameters["cart.mass"])
    sim.set_body_mass("pole", parameters["pole.mass"])
    sim.set_dof("cart", frictionloss=parameters["cart.frictionloss"])
    sim.set_dof(
        "pole", damping=parameters["pole.damping"], frictionloss=parameters["pole.frictionloss"],
        armature=parameters["pole.armature"],
    )  # fmt: skip
    return sim
