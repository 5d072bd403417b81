"""Excitations of a cart with a motor, played with and without the feedback that keeps it on its track."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.motions.behaviours import Behaviour
from deal_hw.motions.excitation import behaviours as excitation
from deal_hw.motions.excitation import plan as excitation_plan
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.motions.excitation.plan import ExcitationBehaviour, ExcitationDesign, make_plan
from deal_hw.types import RobotState, Status

pytestmark = pytest.mark.real_time

SEEDS = range(2000, 2010)
ACCELERATIONS = (2.0, 5.0, 10.0, 20.0, 50.0)
"""Of the cart at full effort [m/s2]."""
STEP_S = 1e-3
FRICTION, DRAG = 0.05, 0.3
"""Dry friction as a share of the full effort, and drag [1/s]."""


def drawn_cart(rng: np.random.Generator) -> tuple[RobotDescription, float]:
    """Return a motor-driven cart with a drawn track, speed limit and rate, and its delay [s]."""
    half, fastest = rng.uniform(0.2, 0.8), rng.choice([1.0, 2.0, math.inf])
    limits = dataclasses.replace(
        DESCRIPTION.limits,
        target=((-1.0, 1.0),),
        target_step=(2.0,),
        target_distance=(2.0,),
        trip_position=((-half, half), (-math.inf, math.inf)),
        trip_velocity=(float(fastest), math.inf),
    )
    rate_hz = float(rng.choice([50.0, 100.0, 200.0]))
    cart = dataclasses.replace(
        DESCRIPTION, actuation="motor", excitation_range=(), limits=limits, control_rate_hz=rate_hz
    )
    return cart, rng.uniform(0.0, 0.03)


def trips(cart: RobotDescription, delay_s: float, behaviour: Behaviour, acceleration: float) -> bool:
    """Play 4 s on a simulated cart and return whether it left its limits."""
    (low, high), fastest = cart.limits.trip_position[0], cart.limits.trip_velocity[0]
    every, delay, count = round(1 / cart.control_rate_hz / STEP_S), round(delay_s / STEP_S), round(4 / STEP_S)
    effort = [0.0] * (count + every + delay)
    x = v = 0.0
    for step in range(count):
        if step % every == 0:
            state = RobotState(
                np.array([x, 0.0]), np.array([v, 0.0]), np.zeros(2), 0, 0, 0, -1, -1, Status.ARMED
            )
            sent = float(behaviour.command(state, step * STEP_S).position_target[0])
            effort[step + delay : step + delay + every] = [sent] * every
        v += STEP_S * (acceleration * (effort[step] - FRICTION * math.tanh(v / 0.01)) - DRAG * v)
        x += STEP_S * v
        if not (low < x < high and abs(v) < fastest):
            return True
    return False


class Without:
    """Stands in for the feedback and adds none."""

    def __init__(self, description: RobotDescription) -> None:
        pass

    def added(self, effort: object, state: RobotState) -> object:
        """Return the effort."""
        return effort


def behaviours(cart: RobotDescription, seed: int) -> dict[str, Behaviour]:
    """Return the excitations by name."""
    plan = make_plan(cart, ExcitationDesign(seed=seed))
    return {
        "multisine": ExcitationBehaviour(plan, cart),
        "rich": RichBehaviour(cart, None, RichConfig(balance_s=0.0, amplitude=0.9), seed),
    }


def tripped(name: str) -> set[tuple[int, float]]:
    """Return the seed and acceleration of each cart that trips, of 50."""
    found = set()
    for seed in SEEDS:
        cart, delay_s = drawn_cart(np.random.default_rng(seed))
        for acceleration in ACCELERATIONS:
            if trips(cart, delay_s, behaviours(cart, seed)[name], acceleration):
                found.add((seed, acceleration))
    return found


def too_fast() -> set[tuple[int, float]]:
    """Return the carts that gain 0.9 times their trip speed before a measurement can show in an effort."""
    found = set()
    for seed in SEEDS:
        cart, delay_s = drawn_cart(np.random.default_rng(seed))
        for acceleration in ACCELERATIONS:
            gained = acceleration * (delay_s + 1.0 / cart.control_rate_hz)
            if gained > 0.9 * cart.limits.trip_velocity[0]:
                found.add((seed, acceleration))
    return found


@pytest.mark.parametrize(("name", "count", "without"), [("multisine", 3, 32), ("rich", 4, 46)])
def test_carts_stay_on_their_track(
    name: str, count: int, without: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 50 carts only those trip that no feedback can catch. The figures stand in Centring's module."""
    found = tripped(name)
    assert found <= too_fast() and len(found) == count
    for module in (excitation, excitation_plan):
        monkeypatch.setattr(module, "Centring", Without)
    assert len(tripped(name)) == without
