"""The refinement's solver where feet touch the floor: windows whose start states follow one by one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.contacts import Sticking, fit_starts
from deal_hw.calib.fit.intervals import CORRELATION_SAMPLES, MISMATCH_CHI2, correlation_time
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.validation.checks import unexplained
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION, parameter_space
from deal_hw.drivers.go2.motions import FEET, sway
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.sim.recordings.target import TargetSensing, record_target
from deal_hw.types import FloatArray

Beginning = Callable[[SampledEpisode, float], SampledEpisode]
Known = Callable[[ParameterSpace, FloatArray], tuple[ParameterSpace, FloatArray]]


@pytest.fixture(scope="module")
def sensed() -> Case:
    """Return a Go2 that reports joints and IMU, noisy and late."""
    return make_case("go2", "sensor", 0, 3.0)


@pytest.mark.slow
def test_smoothed_start_states_settle_to_the_noise(
    sensed: Case, beginning: Beginning, three_unknown: Known
) -> None:
    """At the true parameters no window's cost grows, and what several times the noise was is noise."""
    space, truth = three_unknown(sensed.space, sensed.theta)
    shooting = Shooting(Problem(sensed.robot, space, [beginning(sensed.fit, 1.7)], threads=1), 20)
    before = shooting.start(truth, sensed.latency_s)
    after, cost = fit_starts(shooting, before, 6)
    np.testing.assert_array_equal(after.value, before.value)
    windows = np.array([w for p in (before, after) for w in shooting.window_costs(p)])
    assert np.all(windows[1] <= windows[0])
    assert cost == pytest.approx(windows[1].sum())
    normal = shooting.normal(after)
    assert cost / normal.count < 1.25 < 3.0 < windows[0].sum() / normal.count
    assert correlation_time(normal.residual) < CORRELATION_SAMPLES


@pytest.mark.slow
def test_a_right_model_raises_no_alarm(sensed: Case, beginning: Beginning, three_unknown: Known) -> None:
    """From eight percent off the residual becomes noise, and the parameters come back."""
    space, truth = three_unknown(sensed.space, sensed.theta)
    latency_s = sensed.latency_s
    problem = Problem(sensed.robot, space, [beginning(sensed.fit, 1.7)], threads=1, fixed_latency_s=latency_s)
    found = refine(problem, truth * [1.08, 0.92, 1.08], latency_s, (0.4,), iterations=8)
    assert found.chi2 < MISMATCH_CHI2
    assert not unexplained(found)
    np.testing.assert_allclose(found.theta, truth, rtol=0.05)


@pytest.mark.slow
def test_friction_that_the_model_lacks_is_not_explained_away(three_unknown: Known) -> None:
    """Start states of their own cannot hide 0.5 N·m of dry friction in each knee."""
    rng = np.random.default_rng(3)
    robot, real = load_model(DESCRIPTION), load_model(DESCRIPTION)
    real.model.dof_frictionloss[list(real.qvel)[2::3]] += 0.5
    whole = parameter_space().with_ratio(3.0)
    sensing = TargetSensing(
        joint_std=DESCRIPTION.sensor.noise,
        joint_resolution=DESCRIPTION.sensor.resolution,
        orientation_std=4e-3,
        gyro_std=0.02,
        feet=FEET,
    )
    target = record_target(
        real, whole, whole.nominal, sway(robot, rng, 1.7), seconds=1.7, sensing=sensing, rng=rng
    )
    space, truth = three_unknown(whole, whole.nominal)
    problem = Problem(robot, space, [target.episode], threads=1, fixed_latency_s=0.0)
    shooting = Shooting(problem, 20)
    point, cost = fit_starts(shooting, shooting.start(truth, 0.0), 6)
    normal = shooting.normal(point)
    assert cost / normal.count > MISMATCH_CHI2 or correlation_time(normal.residual) > CORRELATION_SAMPLES


def test_backward_differences_agree_with_forward_ones(small_problem: Callable[..., Problem]) -> None:
    """On a smooth cart-pole both linearisations are the same to the step's order."""
    problem = small_problem()
    shooting = Shooting(problem, 10)
    point = shooting.start(problem.space.nominal, 0.0)
    forward, backward = shooting.normal(point), shooting.normal(point, stretch=-1.0)
    assert backward.cost == pytest.approx(forward.cost)
    np.testing.assert_allclose(backward.gradient[:-1], forward.gradient[:-1], rtol=0.02)


def test_strategy_keeps_the_best_point_and_hands_the_solver_its_residual(
    small_problem: Callable[..., Problem],
) -> None:
    """The residual's square is the cost of its point; a worse value moves nothing that is kept."""
    problem = small_problem()
    shooting = Shooting(problem, 10)
    start = shooting.start(problem.space.nominal, 0.0)
    fit = Sticking(shooting, start, 1.0)
    residual = fit.residual(start.value)
    assert fit.best_cost == pytest.approx(residual @ residual)
    assert fit.best_cost <= shooting.cost(start)
    jacobian = fit.jacobian(start.value)
    assert jacobian.shape == (len(residual), len(start.value))
    step = np.append(0.3 * np.linalg.lstsq(jacobian[:, :-1], residual, rcond=None)[0], 0.0)
    better = fit.residual(start.value - step)
    assert better @ better < residual @ residual and fit.best_cost == pytest.approx(better @ better)
    fit.residual(start.value + 5 * step)
    np.testing.assert_array_equal(fit.best.value, start.value - step)


def test_the_cost_is_the_sum_of_windows(small_problem: Callable[..., Problem]) -> None:
    """And that of all whitened residuals, from the same prediction."""
    shooting = Shooting(small_problem(), 10)
    point = shooting.start(1.3 * shooting.problem.space.nominal, 0.0)
    residual = shooting.vector(point)
    assert shooting.cost(point) == pytest.approx(residual @ residual)
    assert shooting.cost(point) == pytest.approx(
        sum(of_episode.sum() for of_episode in shooting.window_costs(point))
    )
