"""`least-squares`: the contract, and what the textbook leaves out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.baselines.least_squares import (
    LeastSquaresBaseline,
    OneStep,
    from_random_start,
    textbook_covariance,
)
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]


class TestLeastSquares(MethodSuite):
    """`least-squares` on clean states: within 0.1 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=LeastSquaresBaseline(),
            make_problem=small_problem,
            truth=recorded()[1],
            budget=Budget(generations=30),
            short_budget=Budget(generations=2),
            tolerance=1e-3,
            open_store=SearchCheckpoint,
        )


def test_a_random_start_is_drawn_in_the_linear_ranges(small_problem: Callable[..., Problem]) -> None:
    """Without an iteration left it ends at the generator's own draw, another for each seed."""
    problem = small_problem()
    space = problem.space
    for seed in (0, 1):
        found = from_random_start().run(problem, Budget(generations=1), np.random.default_rng(seed))
        drawn = np.random.default_rng(seed).uniform(space.low, space.high)
        np.testing.assert_allclose(found.estimate, drawn, rtol=1e-9)
    again = from_random_start().run(problem, Budget(generations=60), np.random.default_rng(1))
    midpoint = LeastSquaresBaseline().run(problem, Budget(generations=60), np.random.default_rng(1))
    np.testing.assert_allclose(again.estimate, midpoint.estimate, rtol=1e-3)


def test_says_when_it_has_not_converged(small_problem: Callable[..., Problem]) -> None:
    """Two iterations are not enough, and the result says so."""
    result = LeastSquaresBaseline().run(small_problem(), Budget(generations=2), np.random.default_rng(0))
    assert ["not converged after 2 iterations" in alarm.seen for alarm in result.alarms] == [True]
    assert result.provenance["iterations"] == 2


def test_takes_no_latency_but_a_given_one(
    recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]
) -> None:
    """Where the latency is to be found it assumes none, and its estimate pays for it; given, it is exact."""
    theta = recorded(latency_ticks=8)[1]
    rng = np.random.default_rng(0)
    ignorant = LeastSquaresBaseline().run(small_problem(latency_ticks=8, fixed_latency_s=None), Budget(), rng)
    reported = LeastSquaresBaseline().run(small_problem(latency_ticks=8, fixed_latency_s=8e-3), Budget(), rng)
    assert ignorant.latency_s == 0.0
    assert ignorant.provenance["assumed_latency_s"] == 0.0
    assert reported.latency_s == 8e-3
    assert np.mean(np.abs(np.log(reported.estimate / theta))) < 1e-3
    assert np.mean(np.abs(np.log(ignorant.estimate / theta))) > 0.02


def test_one_step_error_vanishes_at_the_truth_only(
    recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]
) -> None:
    """Positions and velocities one control period ahead, each in parts of its usual change."""
    error = OneStep(small_problem(), 0.0)
    space, theta, _ = recorded()
    at_truth, at_nominal = error.residual(space.to_scale(np.stack([theta, space.nominal])))
    # The wire's micrometre over the usual change of some millimetres.
    assert np.max(np.abs(at_truth)) < 0.01
    assert np.max(np.abs(at_nominal)) > 0.1


def test_textbook_covariance_of_a_line(recorded: Callable[..., Recorded]) -> None:
    """Residuals (1, -1, 1, -1), two parameters: s^2 = 4 / (4 - 2) = 2, J'J = 4 I: 0.5 I but for the range."""
    space = recorded()[0]
    jacobian = np.array([[1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [1.0, -1.0]])
    covariance = textbook_covariance(space, jacobian, np.array([1.0, -1.0, 1.0, -1.0]))
    expected = 1.0 / (4.0 / 2.0 + 12.0 / space.width**2)
    np.testing.assert_allclose(covariance, np.diag(expected), atol=1e-12)
