"""What is expected of a parameter counts in the baselines that minimise squares, as in the refinement."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.baselines.gauss_newton import GaussNewton, GaussNewtonSettings
from deal_hw.calib.baselines.least_squares import LeastSquaresBaseline
from deal_hw.calib.data.problem import Problem
from deal_hw.calibration import Budget, CalibrationMethod
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align

FREE = ("cart.frictionloss", "servo.damping")
METHODS = {
    "gauss-newton": GaussNewton(GaussNewtonSettings(draws=20, starts=3, survivors=2)),
    "least-squares": LeastSquaresBaseline(),
}


def space(std: float | None = None, factor: float = 1.3) -> ParameterSpace:
    """Return two free parameters, the friction expected at a factor of its nominal, true, value."""
    plain = k9_space().with_ratio(5.0).with_free(FREE)
    if std is None:
        return plain
    return ParameterSpace(
        dataclasses.replace(p, prior_mean=factor * p.nominal, prior_std=std) if p.name == FREE[0] else p
        for p in plain.parameters
    )


@pytest.fixture(scope="module")
def episode() -> SampledEpisode:
    """Return 1.2 s of a cart-pole with nominal values, reported through its noisy sensor."""
    plain = space()
    made = simulated_episode(DESCRIPTION, plain, plain.nominal, seconds=1.2, sensor=True, seed=2)
    return align(made, DESCRIPTION)


def found(
    method: CalibrationMethod[Problem], searched: ParameterSpace, episode: SampledEpisode
) -> tuple[float, float]:
    """Return the friction as a ratio of its true value, and its standard deviation (log)."""
    problem = Problem(load_model(DESCRIPTION), searched, [episode], threads=1, fixed_latency_s=0.0)
    result = method.run(problem, Budget(population=20, generations=25), np.random.default_rng(0))
    k = searched.names.index(FREE[0])
    assert result.covariance is not None
    return float(result.estimate[k] / searched.nominal[k]), float(np.sqrt(result.covariance[k, k]))


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_priors_count(name: str, episode: SampledEpisode) -> None:
    """Nothing for a vague one; a tight one wins; one as sharp as the data meets them half way."""
    method = METHODS[name]
    free, std = found(method, space(), episode)
    vague, _ = found(method, space(std=100.0), episode)
    assert vague == pytest.approx(free, rel=1e-3)
    tight, narrow = found(method, space(std=1e-3 * std), episode)
    assert tight == pytest.approx(1.3, rel=1e-3)
    assert narrow < 0.01 * std
    factor = free * np.exp(2 * std)
    half, narrower = found(method, space(std=std, factor=factor), episode)
    # Two equally sharp pieces of knowledge, two standard deviations apart: the middle, a factor 1.4 sharper.
    assert np.log(half / free) / std == pytest.approx(1.0, abs=0.35)
    assert narrower == pytest.approx(std / np.sqrt(2), rel=0.25)
