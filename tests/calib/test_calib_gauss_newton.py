"""`gauss-newton`: the contract, noise and latency, restarts, and intervals that are those of the data."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.baselines.gauss_newton import GaussNewton, GaussNewtonSettings, Innovations
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget, Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

TRUTH = {"cart.frictionloss": 0.4, "servo.damping": 2.5}
"""Factors of the nominal values."""

LATENCY_TICKS = 7
SMALL = GaussNewtonSettings(draws=20, starts=3, survivors=2)


@functools.cache
def recorded(sensor: bool) -> tuple[ParameterSpace, FloatArray, SampledEpisode]:
    """Return a space with two free parameters, their true values, and a recording."""
    space = k9_space().with_ratio(5.0).with_free(TRUTH)
    theta = np.array([p.nominal * TRUTH[p.name] for p in space])
    seconds, ticks = (2.0, LATENCY_TICKS) if sensor else (1.2, 0)
    trajectory = simulated_episode(
        DESCRIPTION, space, theta, seconds=seconds, latency_ticks=ticks, sensor=sensor
    )
    return space, theta, align(trajectory, DESCRIPTION)


def problem(sensor: bool = False) -> Problem:
    """Return the problem of finding them; the latency is given unless there is noise."""
    space, _, episode = recorded(sensor)
    robot = load_model(DESCRIPTION)
    return Problem(robot, space, [episode], threads=1, fixed_latency_s=None if sensor else 0.0)


class TestGaussNewton(MethodSuite):
    """`gauss-newton`: within 0.1 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=GaussNewton(SMALL),
            make_problem=problem,
            truth=recorded(False)[1],
            budget=Budget(population=20, generations=20),
            short_budget=Budget(population=10, generations=3),
            tolerance=1e-3,
            open_store=SearchCheckpoint,
        )


@pytest.mark.slow
def test_finds_parameters_and_latency_under_noise() -> None:
    """Two parameters within 10 %, the latency within 1 ms, all inside the stated intervals."""
    made = problem(sensor=True)
    result = GaussNewton(SMALL).run(made, Budget(population=20, generations=30), np.random.default_rng(0))
    theta = recorded(True)[1]
    assert np.all(np.abs(np.log(result.estimate / theta)) < 0.1)
    assert abs(result.latency_s - LATENCY_TICKS / DESCRIPTION.device_rate_hz) < 1e-3
    assert np.all((result.interval[:, 0] < theta) & (theta < result.interval[:, 1]))
    assert result.chi2 < 1.5
    assert result.provenance["restarts"] == 0
    assert result.verdicts == ("identifiable", "identifiable")


def test_draws_again_while_the_residual_is_unexplained() -> None:
    """With a bar that nothing passes the budget is used up, and the multi-starts are counted."""
    settings = GaussNewtonSettings(draws=10, starts=2, survivors=1, rounds=1, restart_chi2=0.0)
    stages: list[float] = []

    def watch(progress: Progress) -> None:
        stages.append(progress.values["stage"])

    result = GaussNewton(settings).run(
        problem(), Budget(population=10, generations=11), np.random.default_rng(1), watch
    )
    assert len(stages) == 11
    assert result.provenance["restarts"] >= 2
    assert stages[:5] == [-1.0, 0.0, 0.0, 1.0, -1.0]


def test_derivatives_are_slopes() -> None:
    """A column of the Jacobian is a slope of the residual; nothing leads along a latency that is given."""
    base = np.append(problem().space.to_scale(recorded(False)[1]), 0.0)
    innovations = Innovations(problem(), 5, base, follow=False)
    value, step = base + np.array([0.3, -0.2, 0.0]), np.array([1e-3, 0.0, 0.0])
    jacobian, residual = innovations.jacobian(value), innovations.residual(value)
    ahead, behind = innovations.residuals(np.stack([value + step, value - step]))
    slope = (ahead @ ahead - behind @ behind) / (4 * 1e-3)
    assert jacobian[:, 0] @ residual == pytest.approx(slope, rel=0.02)
    assert not jacobian[:, 2].any()
    assert len(residual) == sum(part.size for part in innovations.split(residual))
