"""`least-squares`: the contract, and what the textbook leaves out."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from deal_hw.calib.baselines.least_squares import LeastSquares, OneStep, textbook_covariance
from deal_hw.calib.checkpoint import Checkpoint
from deal_hw.calib.problem import Problem
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.episode import Episode, align
from deal_hw.sim.model import load_model
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.testing.simulated_episode import simulated_episode
from deal_hw.types import FloatArray

TRUTH = {"cart.frictionloss": 0.4, "servo.damping": 2.5}
"""Factors of the nominal values."""


@functools.cache
def recorded(latency_ticks: int = 0) -> tuple[ParameterSpace, FloatArray, Episode]:
    """Return a space with two free parameters, their true values, and 1.2 s of a noise-free recording."""
    space = k9_space().with_ratio(5.0).with_free(TRUTH)
    theta = np.array([p.nominal * TRUTH[p.name] for p in space])
    trajectory = simulated_episode(DESCRIPTION, space, theta, seconds=1.2, latency_ticks=latency_ticks)
    return space, theta, align(trajectory, DESCRIPTION)


def problem(latency_ticks: int = 0, fixed_latency_s: float | None = 0.0) -> Problem:
    """Return the problem of finding them."""
    space, _, episode = recorded(latency_ticks)
    return Problem(load_model(DESCRIPTION), space, [episode], threads=1, fixed_latency_s=fixed_latency_s)


class TestLeastSquares(MethodSuite):
    """`least-squares` on clean states: within 0.1 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=LeastSquares(),
            make_problem=problem,
            truth=recorded()[1],
            budget=Budget(generations=30),
            short_budget=Budget(generations=2),
            tolerance=1e-3,
            open_store=Checkpoint,
        )


def test_says_when_it_has_not_converged() -> None:
    """Two iterations are not enough, and the result says so."""
    result = LeastSquares().run(problem(), Budget(generations=2), np.random.default_rng(0))
    assert result.alarms == ("not converged after 2 iterations",)
    assert result.provenance["iterations"] == 2


def test_takes_no_latency_but_a_given_one() -> None:
    """Where the latency is to be found it assumes none, and its estimate pays for it; given, it is exact."""
    theta = recorded(8)[1]
    rng = np.random.default_rng(0)
    ignorant = LeastSquares().run(problem(8, None), Budget(), rng)
    told = LeastSquares().run(problem(8, 8e-3), Budget(), rng)
    assert ignorant.latency_s == 0.0
    assert ignorant.provenance["assumed_latency_s"] == 0.0
    assert told.latency_s == 8e-3
    assert np.mean(np.abs(np.log(told.estimate / theta))) < 1e-3
    assert np.mean(np.abs(np.log(ignorant.estimate / theta))) > 0.02


def test_one_step_error_vanishes_at_the_truth_only() -> None:
    """Positions and velocities one control period ahead, each in parts of its usual change."""
    error = OneStep(problem(), 0.0)
    space, theta, _ = recorded()
    at_truth, at_nominal = error.residual(space.to_scale(np.stack([theta, space.nominal])))
    # The wire's micrometre over the usual change of some millimetres.
    assert np.max(np.abs(at_truth)) < 0.01
    assert np.max(np.abs(at_nominal)) > 0.1


def test_textbook_covariance_of_a_line() -> None:
    """Residuals (1, -1, 1, -1), two parameters: s^2 = 4 / (4 - 2) = 2, J'J = 4 I: 0.5 I but for the range."""
    space = recorded()[0]
    jacobian = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [1.0, -1.0]])
    covariance = textbook_covariance(space, jacobian, np.array([1.0, -1.0, 1.0, -1.0]))
    expected = 1.0 / (4.0 / 2.0 + 12.0 / space.width**2)
    np.testing.assert_allclose(covariance, np.diag(expected), atol=1e-12)
