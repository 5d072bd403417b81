"""`mujoco-sysid`: the contract, the translation of models and recordings, and what it cannot express."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import re
import types

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.baselines.sysid import MujocoSysid, SysidSettings, with_delay
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError, MissingExtraError
from deal_hw.install import install_line
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.sim.recordings.sysid_adapter import SysidRecording, identify, require_sysid
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

TRUTH = {"cart.frictionloss": 0.4, "servo.damping": 2.5, "servo.speed_limit": 0.5}
"""Factors of the nominal values."""

needs_sysid = pytest.mark.usefixtures("sysid")


@pytest.fixture(scope="module")
def sysid() -> None:
    """Skip what needs `mujoco.sysid` where that is not installed."""
    try:
        require_sysid()
    except MissingExtraError as error:
        pytest.skip(str(error))


@functools.cache
def recorded(latency_ticks: int = 0) -> tuple[ParameterSpace, FloatArray, SampledEpisode]:
    """Return a space with three free parameters, their true values, and 1.2 s of a noise-free recording."""
    space = k9_space().with_ratio(5.0).with_free(TRUTH)
    theta = np.array([p.nominal * TRUTH[p.name] for p in space])
    trajectory = simulated_episode(DESCRIPTION, space, theta, seconds=1.2, latency_ticks=latency_ticks)
    return space, theta, align(trajectory, DESCRIPTION)


def problem(latency_ticks: int = 0, fixed_latency_s: float | None = 0.0) -> Problem:
    """Return the problem of finding them."""
    space, _, episode = recorded(latency_ticks)
    return Problem(load_model(DESCRIPTION), space, [episode], threads=1, fixed_latency_s=fixed_latency_s)


@needs_sysid
class TestMujocoSysid(MethodSuite):
    """`mujoco-sysid` on a clean recording: within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=MujocoSysid(),
            make_problem=problem,
            truth=recorded()[1],
            budget=Budget(generations=30),
            short_budget=Budget(generations=2),
            tolerance=5e-3,
            open_store=SearchCheckpoint,
        )


@needs_sysid
def test_latency_is_zero_unless_given() -> None:
    """Its user knows of none; with what was found by other means it finds the parameters, and says so."""
    theta, rng = recorded(8)[1], np.random.default_rng(0)
    ignorant = MujocoSysid().run(problem(8, None), Budget(generations=12), rng)
    noted = MujocoSysid(SysidSettings(latency_s=8e-3)).run(problem(8, None), Budget(generations=12), rng)
    assert ignorant.latency_s == 0.0
    assert "0 ms of latency (none" in ignorant.provenance["interval"]
    assert noted.latency_s == 8e-3
    assert "8 ms of latency (given)" in noted.provenance["interval"]
    errors = [np.mean(np.abs(np.log(r.estimate / theta))) for r in (ignorant, noted)]
    assert errors[1] < 5e-3 < 0.02 < errors[0]


@needs_sysid
def test_a_delay_is_found_with_the_parameters() -> None:
    """Commands 8 ms late: found to 0.2 ms by its own least squares, and the parameters to 0.5 %."""
    theta, rng = recorded(8)[1], np.random.default_rng(0)
    found = with_delay(0.4).run(problem(8, None), Budget(generations=30), rng)
    assert found.latency_s == pytest.approx(8e-3, abs=2e-4)
    assert np.mean(np.abs(np.log(found.estimate / theta))) < 5e-3
    given = with_delay(0.4).run(problem(8, 8e-3), Budget(generations=12), rng)
    assert given.latency_s == 8e-3 and "(given)" in given.provenance["interval"]


@needs_sysid
def test_its_residual_is_our_prediction() -> None:
    """At the same values, latency, gains other than the default ones and a lost sample, to rounding."""
    space, _, episode = recorded()
    reported = np.ones(len(episode.sample), dtype=bool)
    reported[30] = False
    changed = dataclasses.replace(
        episode,
        stiffness=1.3 * episode.stiffness,
        damping=0.8 * episode.damping,
        effort_limit=0.5 * episode.effort_limit,
        reported=reported,
    )
    robot = load_model(DESCRIPTION)
    made = Problem(robot, space, [changed], threads=1, fixed_latency_s=2.5e-3)
    data = made.windows(40)[0]
    recording = SysidRecording(made.episodes[0], data.windows, data.start_position, data.start_velocity)
    found = identify(robot, space, [recording], latency_s=2.5e-3, iterations=1, threads=1)
    predicted = made.predict(found.theta[None], np.array([2.5e-3]), data).position[0]
    rows = data.windows.start[:, None] + np.arange(41)
    seen = np.where(reported[:, None], changed.position, np.nan)[rows]
    scale = np.sqrt(np.nanmean(seen.reshape(-1, 2) ** 2, axis=0))
    expected = np.nan_to_num((seen[:, 1:] - predicted) / scale)
    np.testing.assert_allclose(found.residual.reshape(expected.shape), expected, atol=1e-9)
    assert found.steps > 0


@needs_sysid
def test_what_it_cannot_express_is_refused() -> None:
    """The error names the parameter and the kinds that are possible."""
    space, _, episode = recorded()
    bias = Parameter(
        name="pole.bias",
        kind="encoder_bias",
        elements=("pole",),
        unit="rad",
        nominal=0.0,
        low=-0.1,
        high=0.1,
        scale="linear",
    )
    wider = ParameterSpace([*space.parameters, bias])
    made = Problem(load_model(DESCRIPTION), wider, [episode], threads=1, fixed_latency_s=0.0)
    with pytest.raises(
        ConfigurationError, match=r"no counterpart for pole\.bias \(encoder_bias\); it takes .*body_mass"
    ):
        MujocoSysid().run(made, Budget(), np.random.default_rng(0))


@needs_sysid
def test_positions_must_have_been_measured() -> None:
    """A recording of velocities alone is none that it can use."""
    space, _, episode = recorded()
    measured = np.array([False, True, True, True])
    partly = dataclasses.replace(episode, measured=measured, estimate_std=np.full(4, 1e-3))
    made = Problem(load_model(DESCRIPTION), space, [partly], threads=1, fixed_latency_s=0.0)
    with pytest.raises(ConfigurationError, match="those of cart were not measured"):
        MujocoSysid().run(made, Budget(), np.random.default_rng(0))


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its dependencies the package is empty; the error says what to install."""
    monkeypatch.setattr(importlib, "import_module", lambda _: types.ModuleType("empty"))
    with pytest.raises(MissingExtraError, match=re.escape(install_line("bench"))):
        require_sysid()
