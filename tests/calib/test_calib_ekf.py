"""`ekf`: the filter against exact answers, and the contract."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.baselines.ekf import Ekf, EkfSettings, ExtendedKalman, one_pass
from deal_hw.calib.data.parts import taken
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]


class TestEkf(MethodSuite):
    """`ekf` on a clean recording: within 5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=Ekf(),
            make_problem=lambda: small_problem(seconds=0.8),
            truth=recorded(seconds=0.8)[1],
            budget=Budget(generations=8),
            short_budget=Budget(generations=2),
            tolerance=0.05,
            open_store=SearchCheckpoint,
        )


def slope_filter(noise: FloatArray | None = None) -> ExtendedKalman:
    """Return a filter of x that grows by an unknown a at each step: mean (0, 0.5), variances (1, 4)."""
    return ExtendedKalman(
        np.array([0.0, 0.5]),
        np.diag([1.0, 4.0]),
        moving=1,
        step=np.array([1e-3, 1e-3]),
        noise=np.zeros(2) if noise is None else noise,
    )


def advance(kalman: ExtendedKalman, measured: float, std: float) -> float:
    """Take one step of x' = x + a, y = x'."""
    points = kalman.ask()
    moved = points[:, :1] + points[:, 1:]
    return kalman.tell(moved, moved, np.array([measured]), np.array([std]))


def test_filter_takes_the_step_computed_by_hand() -> None:
    """One linear step.

    F = [[1, 1], [0, 1]], so P- = [[5, 4], [4, 4]] around (0.5, 0.5). A measurement of 2 +- 1 is off by 1.5
    with S = 5 + 1 = 6 and the gain (5, 4) / 6: mean (0.5 + 1.25, 0.5 + 1), P = P- - (5, 4)'(5, 4) / 6.
    """
    kalman = slope_filter()
    assert advance(kalman, 2.0, 1.0) == pytest.approx(1.5**2 / 6)
    np.testing.assert_allclose(kalman.mean, [1.75, 1.5], rtol=1e-9)
    np.testing.assert_allclose(kalman.covariance, [[5 / 6, 2 / 3], [2 / 3, 4 / 3]], rtol=1e-8)


def test_filter_without_a_measurement_only_predicts() -> None:
    """An infinite standard deviation says that nothing was reported."""
    kalman = slope_filter()
    assert math.isnan(advance(kalman, 123.0, math.inf))
    np.testing.assert_allclose(kalman.mean, [0.5, 0.5])
    np.testing.assert_allclose(kalman.covariance, [[5.0, 4.0], [4.0, 4.0]], rtol=1e-8)


def test_noise_enters_before_the_step() -> None:
    """Variances (1, 0) added to x first: P- = F [[2, 0], [0, 4]] F' = [[6, 4], [4, 4]]."""
    kalman = slope_filter(np.array([1.0, 0.0]))
    advance(kalman, 0.0, math.inf)
    np.testing.assert_allclose(kalman.covariance, [[6.0, 4.0], [4.0, 4.0]], rtol=1e-8)


def test_filter_equals_the_regression_on_a_linear_model() -> None:
    """Twenty steps of x + a t give the mean and covariance of weighted least squares with the prior."""
    rng = np.random.default_rng(3)
    times = np.arange(1.0, 21.0)
    measured = 0.2 + 0.7 * times + 0.5 * rng.standard_normal(20)
    kalman = slope_filter()
    for y in measured:
        advance(kalman, float(y), 0.5)
    design = np.column_stack([np.ones(20), times])
    information = design.T @ design / 0.25 + np.diag([1.0, 0.25])
    mean = np.linalg.solve(information, design.T @ measured / 0.25 + np.array([0.0, 0.5 * 0.25]))
    # The filter's x is the one after twenty steps.
    to_last = np.array([[1.0, 20.0], [0.0, 1.0]])
    np.testing.assert_allclose(kalman.mean, to_last @ mean, rtol=1e-6)
    exact = to_last @ np.linalg.inv(information) @ to_last.T
    np.testing.assert_allclose(kalman.covariance, exact, rtol=1e-5)


def test_restart_keeps_the_parameters_and_forgets_the_rest() -> None:
    """After a gap the state is that of the recording, and no correlation with it is left."""
    kalman = slope_filter()
    advance(kalman, 2.0, 1.0)
    kalman.restart(np.array([7.0]), np.array([0.1]))
    np.testing.assert_allclose(kalman.mean, [7.0, 1.5], rtol=1e-9)
    np.testing.assert_allclose(kalman.covariance, np.diag([0.01, 4 / 3]), rtol=1e-8)


@pytest.mark.slow
def test_latency_is_one_more_state(
    recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]
) -> None:
    """A latency of zero is found from the middle of its range, within 1 ms, and stated with an interval."""
    result = Ekf().run(small_problem(seconds=0.8, fixed_latency_s=None), Budget(), np.random.default_rng(0))
    assert result.latency_s < 1e-3
    assert 0.0 <= result.latency_interval_s[0] <= result.latency_s <= result.latency_interval_s[1]
    assert np.mean(np.abs(np.log(result.estimate / recorded(seconds=0.8)[1]))) < 0.05


def test_a_diverged_filter_says_so(recorded: Callable[..., Recorded]) -> None:
    """A model that is known to have twice the right stiffness leaves innovations that nothing explains."""
    space, _, episode = recorded(seconds=0.8)
    wrong = space.with_known({"servo.stiffness": 2.0 * space["servo.stiffness"].nominal})
    made = Problem(load_model(DESCRIPTION), wrong, [episode], threads=1, fixed_latency_s=0.0)
    result = Ekf(EkfSettings(passes=2)).run(made, Budget(), np.random.default_rng(0))
    assert result.chi2 > 3.0
    assert "diverged" in result.alarms[0].means


def test_one_pass_is_one(small_problem: Callable[..., Problem]) -> None:
    """It has the sensors' own noise from the start; `ekf` cut to one pass has 30 times that."""
    problem = small_problem(seconds=0.8)
    found = one_pass().run(problem, Budget(), np.random.default_rng(0))
    assert found.method == "ekf-one-pass" and len(found.trace) == 1
    plain = Ekf(EkfSettings(first_noise_factor=1.0)).run(
        problem, Budget(generations=1), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(found.estimate, plain.estimate)
    noisy = Ekf().run(problem, Budget(generations=1), np.random.default_rng(0))
    assert np.abs(np.log(found.estimate / noisy.estimate)).max() > 1e-3


def test_passes_start_with_the_prior_that_a_parameter_has(recorded: Callable[..., Recorded]) -> None:
    """Zero drift and a sharp prior at the wrong value: the filter hardly moves from it."""
    space, _, episode = recorded(seconds=0.8)
    sharp = ParameterSpace(
        p if p.known else dataclasses.replace(p, prior_mean=p.nominal, prior_std=1e-6)
        for p in space.parameters
    )
    made = Problem(load_model(DESCRIPTION), sharp, [episode], threads=1, fixed_latency_s=0.0)
    settings = EkfSettings(passes=1, parameter_drift=0.0, first_noise_factor=1e6)
    result = Ekf(settings).run(made, Budget(), np.random.default_rng(0))
    np.testing.assert_allclose(result.estimate, sharp.nominal, rtol=1e-3)


def test_one_window_of_several_is_that_window(small_problem: Callable[..., Problem]) -> None:
    """Arrays keep their shape but for the count."""
    data = small_problem(seconds=0.8).windows(3)[0]
    one = taken(data, np.array([4]))
    assert len(one.windows) == 1
    assert one.windows.start[0] == data.windows.start[4]
    np.testing.assert_array_equal(one.measured[0], data.measured[4])
    np.testing.assert_array_equal(one.prior_std[0], data.prior_std[4])
