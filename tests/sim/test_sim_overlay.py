"""Overlays: predictions in windows, checked against simulated recordings and by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError, InsufficientDataError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.overlay import Overlay, compute_overlay, reported_velocity_window
from deal_hw.types import FloatArray, Trajectory

LATENCY_TICKS = 12
SPACE = k9_space()


@pytest.fixture(scope="module")
def truth() -> FloatArray:
    """Parameters up to 65 % off the nominal ones."""
    return SPACE.nominal * np.exp(np.random.default_rng(1).uniform(-0.5, 0.5, len(SPACE)))


@pytest.fixture(scope="module")
def exact(truth: FloatArray) -> Trajectory:
    """A recording without noise, 12 ms late."""
    return simulated_episode(DESCRIPTION, SPACE, truth, seconds=2.0, latency_ticks=LATENCY_TICKS)


@pytest.fixture(scope="module")
def overlay(exact: Trajectory, truth: FloatArray) -> Overlay:
    """The truth and the nominal model beside it, from the reported states as they are."""
    sets = {"nominal": SPACE.nominal, "calibrated": truth}
    return compute_overlay(exact, DESCRIPTION, SPACE, sets, latency_s=LATENCY_TICKS * 1e-3, smoothing_s=0.0)


def test_truth_predicts_itself(overlay: Overlay) -> None:
    """The robot's own parameters and latency leave no error; the nominal ones leave a plain one."""
    assert overlay.predictions["calibrated"].position_nrmse == pytest.approx([0, 0], abs=1e-8)
    assert overlay.predictions["calibrated"].velocity_nrmse == pytest.approx([0, 0], abs=1e-8)
    assert np.abs(overlay.position_error("calibrated")).max() < 1e-9
    assert (overlay.predictions["nominal"].position_nrmse > 0.005).all()


def test_wrong_latency_shows(exact: Trajectory, truth: FloatArray, overlay: Overlay) -> None:
    """The truth with no latency errs, so latency is not ignored."""
    late = compute_overlay(exact, DESCRIPTION, SPACE, {"calibrated": truth}, latency_s=0.0, smoothing_s=0.0)
    assert (late.predictions["calibrated"].position_nrmse > 1e-3).all()


def test_windows_restart_from_the_measured_state(overlay: Overlay, exact: Trajectory) -> None:
    """Each window starts where the robot was and spans 40 samples of 5 ms; the next starts where it ends."""
    assert overlay.window_s == pytest.approx(0.2)
    assert overlay.sample.shape[1] == 41
    assert (np.diff(overlay.sample, axis=1) == 1).all()
    assert (overlay.sample[1:, 0] == overlay.sample[:-1, -1]).all()
    first = overlay.sample[:, 0]
    for prediction in overlay.predictions.values():
        np.testing.assert_array_equal(prediction.position[:, 0], exact.position[first])
        np.testing.assert_array_equal(prediction.velocity[:, 0], exact.velocity[first])
    np.testing.assert_array_equal(overlay.position, exact.position[overlay.sample])
    np.testing.assert_array_equal(overlay.device_s, exact.device_s[overlay.sample])


def test_shorter_windows_err_less(exact: Trajectory) -> None:
    """Errors grow inside a window, so restarting more often leaves less of them."""
    errors = [
        compute_overlay(
            exact, DESCRIPTION, SPACE, {"nominal": SPACE.nominal}, latency_s=0.012, window_s=window_s
        )
        .predictions["nominal"]
        .position_nrmse
        for window_s in (0.05, 0.2)
    ]
    assert (errors[0] < 0.5 * errors[1]).all()


def test_error_by_hand(exact: Trajectory) -> None:
    """A cart without force against a measured ramp of 1 mm a sample: errors of 1, 2, 3 and 4 mm."""
    count = 101
    ramp = 1e-3 * np.arange(count)
    still = dataclasses.replace(
        _head(exact, count),
        position=np.stack([ramp, np.full(count, math.pi)], axis=1),
        velocity=np.zeros((count, 2)),
        effort_limit=np.zeros_like(exact.effort_limit),
    )
    got = compute_overlay(
        still, DESCRIPTION, ParameterSpace([]), {"nominal": np.zeros(0)}, window_s=0.02, smoothing_s=0.0
    )
    error = got.position_error("nominal")
    np.testing.assert_allclose(error[..., 0], -1e-3 * np.tile(np.arange(5), (len(error), 1)), atol=1e-12)
    # sqrt((1 + 4 + 9 + 16) / 4) = 2.7386 mm in each window.
    rmse = got.predictions["nominal"].window_rmse[:, 0]
    np.testing.assert_allclose(rmse, 2.7386e-3, rtol=1e-4)
    # The samples in windows span from the first start to the last end.
    span = 1e-3 * (got.sample[-1, -1] - got.sample[0, 0])
    assert got.predictions["nominal"].position_nrmse[0] == pytest.approx(2.7386e-3 / span, rel=1e-4)
    assert np.isnan(got.predictions["nominal"].position_nrmse[1]), "a joint that never moved has no range"
    # All windows err alike, most at their end.
    assert got.worst_moment_s("nominal") in got.device_s[:, -1]


def test_breaks_part_the_windows() -> None:
    """Two windows of three points become one trace with a NaN after each."""
    values = np.array([[[1.0], [2.0], [3.0]], [[4.0], [5.0], [6.0]]])
    np.testing.assert_array_equal(Overlay.broken(values)[:, 0], [1, 2, 3, np.nan, 4, 5, 6, np.nan])
    times = Overlay.broken_time(values[:, :, 0])
    np.testing.assert_array_equal(times, [1, 2, 3, 3, 4, 5, 6, 6])


def test_no_window_straddles_a_gap(exact: Trajectory, truth: FloatArray) -> None:
    """Lost samples end a window before them, and predictions after them are as good as ever."""
    keep = np.r_[0:150, 153 : len(exact.device_s)]
    torn = _rows(exact, keep)
    got = compute_overlay(torn, DESCRIPTION, SPACE, {"calibrated": truth}, latency_s=0.012, smoothing_s=0.0)
    np.testing.assert_allclose(np.diff(got.device_s, axis=1), 0.005, atol=1e-12)
    assert np.abs(got.position_error("calibrated")).max() < 1e-9
    assert got.device_s[-1, -1] > exact.device_s[300]


def test_smoothing_helps_against_noise(truth: FloatArray) -> None:
    """With sensor noise, starts smoothed over 40 ms leave the truth a smaller error than raw ones."""
    noisy = simulated_episode(DESCRIPTION, SPACE, truth, latency_ticks=LATENCY_TICKS, sensor=True)
    error = {}
    for smoothing_s in (0.0, 0.04):
        got = compute_overlay(
            noisy, DESCRIPTION, SPACE, {"calibrated": truth}, latency_s=0.012, smoothing_s=smoothing_s
        )
        error[smoothing_s] = got.predictions["calibrated"].position_nrmse
    assert (error[0.04] < 0.6 * error[0.0]).all()


def test_velocities_are_predicted_as_the_robot_reports_them(exact: Trajectory, truth: FloatArray) -> None:
    """Where the robot differences positions over 20 ms, so does the prediction; the truth then fits."""
    late = np.zeros_like(exact.velocity)
    late[4:] = (exact.position[4:] - exact.position[:-4]) / 0.02
    differenced = dataclasses.replace(exact, velocity=late)
    assert reported_velocity_window(exact, DESCRIPTION) == 0.0
    assert reported_velocity_window(differenced, DESCRIPTION) == pytest.approx(0.02)
    got = compute_overlay(
        differenced, DESCRIPTION, SPACE, {"calibrated": truth}, latency_s=0.012, smoothing_s=0.02
    )
    # Only the parabola that stands in for positions before a window's start leaves an error.
    assert (got.predictions["calibrated"].velocity_nrmse < 0.005).all()
    # The true velocity is 10 ms early; against it the error would be a plain one.
    true_error = np.sqrt(np.mean((exact.velocity - late)[8:] ** 2, axis=0)) / np.ptp(late, axis=0)
    assert (got.predictions["calibrated"].velocity_nrmse < 0.3 * true_error).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"window_s": 0.001}, "at least one sample, 0.005 s, got 0.001 s"),
        ({"window_s": math.nan}, "at least one sample"),
        ({"latency_s": -0.01}, "latency must be 0 s or more, got -0.01 s"),
        ({"smoothing_s": math.inf}, "smoothing time must be 0 s or more"),
    ],
)
def test_unusable_settings_are_refused(exact: Trajectory, changes: dict[str, float], words: str) -> None:
    """A setting that cannot be used is named with its limit."""
    with pytest.raises(ConfigurationError, match=words):
        compute_overlay(exact, DESCRIPTION, SPACE, {"nominal": SPACE.nominal}, **changes)


def test_sets_must_fit_the_space(exact: Trajectory) -> None:
    """A parameter set of the wrong length, or none at all, is refused."""
    with pytest.raises(ConfigurationError, match="'odd' has shape \\(2,\\); the space has 9 free"):
        compute_overlay(exact, DESCRIPTION, SPACE, {"odd": np.ones(2)})
    with pytest.raises(ConfigurationError, match="at least one parameter set"):
        compute_overlay(exact, DESCRIPTION, SPACE, {})


def test_unarmed_recordings_have_no_overlay(exact: Trajectory) -> None:
    """Without armed samples there is nothing to predict, and the error says what to do."""
    with pytest.raises(InsufficientDataError, match="record again"):
        compute_overlay(
            dataclasses.replace(exact, status=np.zeros_like(exact.status)),
            DESCRIPTION,
            SPACE,
            {"nominal": SPACE.nominal},
        )


def _head(trajectory: Trajectory, count: int) -> Trajectory:
    return _rows(trajectory, np.arange(count))


def _rows(trajectory: Trajectory, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Trajectory:
    names = (
        "receive_s",
        "device_s",
        "position",
        "velocity",
        "effort",
        "status",
        "command_sequence",
        "command_age_s",
    )
    return dataclasses.replace(trajectory, **{name: getattr(trajectory, name)[rows] for name in names})
