"""Calibration with command delays and known noise of sensors."""

from __future__ import annotations

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.data.checks import check_delays
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import refine
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align

TICKS = 7
"""Device periods of 1 ms by which the robot acts late."""


def space_with(*more: Parameter) -> ParameterSpace:
    """Return the stiffness of the cart's servo and more."""
    return ParameterSpace([*k9_space().with_ratio(5.0).with_free(["servo.stiffness"]).parameters, *more])


DELAY = Parameter(
    name="cart.delay",
    kind="command_delay",
    elements=("cart",),
    unit="s",
    nominal=0.002,
    low=0.0,
    high=0.02,
    scale="linear",
)


def problem(space: ParameterSpace, latency_s: float | None, *, sensor: bool = False) -> Problem:
    """Return the problem on a cart-pole that acts seven ticks late."""
    plain = space_with()
    trajectory = simulated_episode(
        DESCRIPTION, plain, plain.nominal, seconds=2.0, latency_ticks=TICKS, sensor=sensor
    )
    return Problem(
        load_model(DESCRIPTION), space, [align(trajectory, DESCRIPTION)], threads=1, fixed_latency_s=latency_s
    )


def test_refinement_recovers_the_delay() -> None:
    """Truth recovery: the robot is late by 7 ms, 3 ms of which are the given latency."""
    found = refine(problem(space_with(DELAY), 0.003), np.array([60.0, 0.002]), 0.003)
    assert found.theta[1] == pytest.approx(0.004, abs=1e-5)


def test_delay_of_every_actuator_beside_a_searched_latency_is_refused() -> None:
    """Only their sum can be seen; with the latency given it can be searched."""
    with pytest.raises(ConfigurationError, match=r"cart.delay: .*show only their sum.*--latency"):
        check_delays(problem(space_with(DELAY), None))
    check_delays(problem(space_with(DELAY), 0.003))
    check_delays(problem(space_with(), None))


def test_known_noise_is_what_the_recording_is_weighed_by() -> None:
    """The cart's is given, the pole's estimated as without it."""
    known = Parameter(
        name="cart.noise",
        kind="sensor_noise",
        elements=("cart",),
        unit="m",
        nominal=0.004,
        low=0.0,
        high=1.0,
        scale="linear",
        known=True,
    )
    plain, given = problem(space_with(), 0.0, sensor=True), problem(space_with(known), 0.0, sensor=True)
    assert given.noise_std[0] == given.noise.position_std[0] == 0.004
    assert plain.noise_std[0] < 0.001
    np.testing.assert_array_equal(plain.noise.position_std[1:], given.noise.position_std[1:])
