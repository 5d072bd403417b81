"""Calibration of a robot with a free base: exact states, joints and IMU only, feet that stick and slip."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calib.validation.metrics import HeldOut, signal_range
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.tangent_coordinates import to_quaternion
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.types import FloatArray

Beginning = Callable[[SampledEpisode, float], SampledEpisode]
Known = Callable[[ParameterSpace, FloatArray], tuple[ParameterSpace, FloatArray]]


@pytest.fixture(scope="module")
def exact() -> Case:
    """Return a Go2 whose whole state is reported exactly."""
    return make_case("go2", "ideal", 2, 3.0)


@pytest.fixture(scope="module")
def sensed() -> Case:
    """Return a Go2 that reports joints and IMU, noisy and late."""
    return make_case("go2", "sensor", 2, 3.0)


def test_channels_are_what_a_real_go2_reports(sensed: Case) -> None:
    """Orientation, joints and angular velocity; neither the base's place nor its speed."""
    names = Problem(sensed.robot, sensed.space, [sensed.fit]).channel_names
    assert names[:3] == ("base.rx", "base.ry", "base.rz")
    assert names[3:15] == sensed.robot.description.joint_names
    assert names[15:] == ("base.rx.velocity", "base.ry.velocity", "base.rz.velocity")


def test_noise_is_found_in_the_recording_alone(sensed: Case) -> None:
    """The estimated noise of joints and gyro is the sensors' own to a third, quantisation included."""
    problem = Problem(sensed.robot, sensed.space, [sensed.fit])
    std = problem.noise_std[problem.channels]
    assert sensed.channel_std is not None
    np.testing.assert_allclose(std[3:15].mean(), sensed.channel_std[3:15].mean(), rtol=0.33)
    np.testing.assert_allclose(std[15:].mean(), sensed.channel_std[15:].mean(), rtol=0.33)


def test_the_truth_explains_exact_states_to_rounding(exact: Case) -> None:
    """No residual is left at the truth, and windows have no start states to fit."""
    problem = Problem(exact.robot, exact.space, [exact.fit])
    assert problem.noise_free
    shooting = Shooting(problem, 10)
    normal = shooting.normal(shooting.start(exact.theta, 0.0))
    assert normal.cost / normal.count < 1e-6


def test_refinement_recovers_an_exactly_seen_go2(
    exact: Case, beginning: Beginning, three_unknown: Known
) -> None:
    """From ten percent off, three unknown drive parameters come out to a ten-thousandth."""
    space, truth = three_unknown(exact.space, exact.theta)
    problem = Problem(exact.robot, space, [beginning(exact.fit, 1.5)], fixed_latency_s=0.0)
    found = refine(problem, truth * [1.1, 0.9, 1.1], 0.0, (0.1,))
    np.testing.assert_allclose(found.theta, truth, rtol=1e-4)


@pytest.mark.slow
def test_refinement_recovers_a_go2_from_joints_and_imu(
    sensed: Case, beginning: Beginning, three_unknown: Known
) -> None:
    """From ten percent and 2 ms off: stiffness to 2 %, damping to 10 %, the latency to a millisecond."""
    space, truth = three_unknown(sensed.space, sensed.theta)
    problem = Problem(sensed.robot, space, [beginning(sensed.fit, 1.7)])
    found = refine(problem, truth * [1.1, 0.9, 1.1], sensed.latency_s + 2e-3, (0.2,), iterations=5)
    errors = dict(zip(space.names, np.abs(np.log(found.theta / truth)), strict=True))
    for name, error in errors.items():
        assert error < (0.02 if "stiffness" in name else 0.10), name
    assert found.latency_s == pytest.approx(sensed.latency_s, abs=1e-3)


def test_other_start_states_never_cost_more(sensed: Case, three_unknown: Known) -> None:
    """Each window keeps its start state unless a drawn one explains it better; parameters stay."""
    space, truth = three_unknown(sensed.space, sensed.theta)
    shooting = Shooting(Problem(sensed.robot, space, [sensed.fit]), 10)
    before = shooting.start(truth, sensed.latency_s)
    after = shooting.perturbed(before, 0.5, 20, np.random.default_rng(1))
    assert shooting.cost(after) < shooting.cost(before)
    np.testing.assert_array_equal(after.value, before.value)


def test_heldout_error_counts_measured_coordinates_only(exact: Case, sensed: Case) -> None:
    """The truth predicts another motion exactly; sensed, it is far better than the nominal model."""
    sets = {"nominal": (exact.space.nominal, 0.0), "true": (exact.theta, 0.0)}
    errors = HeldOut(exact.robot, exact.space, [exact.heldout]).errors(sets).nrmse
    assert errors["true"] < 1e-6 < 1e-2 < errors["nominal"]
    sets = {"nominal": (sensed.space.nominal, 0.0), "true": (sensed.theta, sensed.latency_s)}
    errors = HeldOut(sensed.robot, sensed.space, [sensed.heldout]).errors(sets).nrmse
    assert errors["true"] < 0.5 * errors["nominal"]


def test_a_base_that_does_not_move_is_off_by_its_turn(exact: Case) -> None:
    """The error of "null" is the angle from where a window starts, whatever the charts do meanwhile."""
    charts = exact.heldout.reference
    assert charts is not None
    held_out = HeldOut(exact.robot, exact.space, [exact.heldout])
    found = held_out.errors({})
    rotation = [i for i, name in enumerate(found.names) if name.startswith("base.r")]
    turned = []
    for data in held_out.problem.windows(round(0.2 / exact.heldout.period_s)):
        where = Rotation.from_quat(to_quaternion(exact.heldout.position[:, 3:6], charts), scalar_first=True)
        for start, samples in zip(data.windows.start, data.windows.samples(), strict=True):
            turned.append((where[int(start)].inv() * where[samples]).magnitude())
    expected = np.sqrt(np.mean(np.concatenate(turned) ** 2))
    assert expected > 0.01
    np.testing.assert_allclose(np.linalg.norm(found.rmse["null"][rotation]), expected, rtol=0.02)


def test_range_of_a_turning_base_is_that_of_its_turn(exact: Case) -> None:
    """Charts move with the base, so a rotation's range is measured from its first orientation."""
    columns = np.arange(18)
    span = signal_range(exact.fit, exact.fit.position, columns, exact.robot.rotation)
    assert np.all(span[3:6] > 0.01)
    np.testing.assert_allclose(span[6:], np.ptp(exact.fit.position[:, 6:], axis=0))


def test_known_noise_must_have_the_states_shape(exact: Case) -> None:
    """A standard deviation for each position and velocity, or an error that says so."""
    with pytest.raises(ConfigurationError, match=r"expected \(36,\)"):
        Problem(exact.robot, exact.space, [exact.fit], known_std=np.ones(12))


def test_recordings_of_other_channels_do_not_mix(exact: Case, sensed: Case) -> None:
    """Full states and joints with IMU cannot be fitted as one."""
    with pytest.raises(ConfigurationError, match="different channels"):
        Problem(exact.robot, exact.space, [exact.fit, sensed.fit])
    unmeasured = dataclasses.replace(sensed.fit, measured=None, estimate_std=None)
    with pytest.raises(ConfigurationError, match="different channels"):
        Problem(exact.robot, exact.space, [sensed.fit, unmeasured])
