"""What tests of the calibration share: problems of a cart-pole with two free parameters, and recordings."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
import pytest
from fakes.recorded_commands import RecordedCommands
from fakes.simulated_episode import simulated_episode

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import with_rows
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]
Beginning = Callable[[SampledEpisode, float], SampledEpisode]
Known = Callable[[ParameterSpace, FloatArray], tuple[ParameterSpace, FloatArray]]
FREE = ("FL_hip_joint.stiffness", "RR_thigh_joint.stiffness", "FR_calf_joint.damping")
TRUTH = {"cart.frictionloss": 0.4, "servo.damping": 2.5}
"""Factors of the nominal values."""


@functools.cache
def _recorded(seconds: float = 1.2, latency_ticks: int = 0) -> Recorded:
    space = k9_space().with_ratio(5.0).with_free(TRUTH)
    theta = np.array([p.nominal * TRUTH[p.name] for p in space])
    made = simulated_episode(DESCRIPTION, space, theta, seconds=seconds, latency_ticks=latency_ticks)
    return space, theta, align(made, DESCRIPTION)


@pytest.fixture(scope="session")
def ideal() -> Case:
    """A noise-free demonstration of a cart-pole of a tuning seed."""
    return make_case("cartpole", "ideal", 1, 5.0)


@pytest.fixture(scope="session")
def noisy() -> Case:
    """A demonstration of a tuning seed with noise, quantisation and an unknown latency."""
    return make_case("cartpole", "sensor", 2, 5.0)


@pytest.fixture(scope="session")
def noisy_problem(noisy: Case) -> Problem:
    """The noisy demonstration's problem, the latency given."""
    return Problem(noisy.robot, noisy.space, [noisy.fit], threads=1, fixed_latency_s=noisy.latency_s)


@pytest.fixture(scope="session")
def noisy_refined(noisy: Case, noisy_problem: Problem) -> Refined:
    """Where the refinement of the noisy problem ends, in windows of 0.2 s."""
    found = refine(noisy_problem, noisy.theta * 1.02, noisy.latency_s, (0.2,))
    return with_rows(found)


@pytest.fixture(scope="session")
def recorded() -> Callable[..., Recorded]:
    """Return what makes a space with two free parameters, their true values, and a noise-free recording.

    Its arguments are the length (1.2 s) and the latency in device periods (0).
    """
    return _recorded


@pytest.fixture(scope="session")
def small_problem() -> Callable[..., Problem]:
    """Return what makes the problem of finding them; arguments of ``recorded``, and the given latency."""

    def make(seconds: float = 1.2, latency_ticks: int = 0, fixed_latency_s: float | None = 0.0) -> Problem:
        space, _, episode = _recorded(seconds, latency_ticks)
        return Problem(
            load_model(DESCRIPTION),
            space,
            [episode],
            threads=1,
            fixed_latency_s=fixed_latency_s,
            policy=RecordedCommands.of(episode.target, 20),
        )

    return make


@pytest.fixture(scope="session")
def beginning() -> Beginning:
    """Return what cuts a recording after so many seconds."""

    def cut(episode: SampledEpisode, seconds: float) -> SampledEpisode:
        count = round(seconds / episode.period_s)
        names = ("sample", "position", "velocity", "usable", "reference")
        return dataclasses.replace(episode, **{name: getattr(episode, name)[:count] for name in names})

    return cut


@pytest.fixture(scope="session")
def three_unknown() -> Known:
    """Return what leaves three drive parameters of a Go2 unknown: the smaller space, their true values."""

    def known(space: ParameterSpace, theta: FloatArray) -> tuple[ParameterSpace, FloatArray]:
        truth = dict(zip(space.names, map(float, theta), strict=True))
        small = space.with_known({name: value for name, value in truth.items() if name not in FREE})
        return small, np.array([truth[name] for name in small.names])

    return known
