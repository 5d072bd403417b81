"""Clock offset and drift, against numbers worked out by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.data.checks.clock_sync import command_bounds, find_jumps, synchronize
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray, Trajectory

MakeTrajectory = Callable[..., Trajectory]


def test_two_way_offset_by_hand(make_trajectory: MakeTrajectory) -> None:
    """States take 0.4 ms and commands 1.0 ms in a fixture whose clocks agree.

    Upper bounds on host - device: +0.4 ms; lower: 0 - 1.0 = -1.0 ms. Middle: -0.3 ms, half the distance:
    0.7 ms; each bound is loosened by 2 us, so 0.702 ms. The truth, 0, lies inside.
    """
    sync = synchronize(make_trajectory())
    assert sync.offset_s == pytest.approx(-0.3e-3, abs=1e-8)
    assert sync.offset_uncertainty_s == pytest.approx(0.702e-3, abs=2e-6)
    assert sync.drift_ppm == pytest.approx(0.0, abs=1.0)
    assert abs(sync.offset_s) <= sync.offset_uncertainty_s
    assert sync.jumps == ()


def test_drift_range_by_hand(make_trajectory: MakeTrajectory) -> None:
    """Bounds 1.404 ms apart over about 4 s allow slopes up to about 1.404 ms / 3.98 s = 353 ppm."""
    sync = synchronize(make_trajectory())
    assert sync.drift_uncertainty_ppm == pytest.approx(353, abs=3)


@settings(max_examples=40, deadline=None)
@given(
    offset_s=st.floats(-2, 2),
    drift_ppm=st.floats(-300, 300),
    jitter_s=st.floats(0, 5e-3),
    seed=st.integers(0, 99),
)
def test_truth_lies_within_the_uncertainty(
    offset_s: float, drift_ppm: float, jitter_s: float, seed: int
) -> None:
    """Whatever the delays, offset and drift of the clocks lie within what is reported."""
    rng = np.random.default_rng(seed)

    def to_host(device_s: FloatArray) -> FloatArray:
        return device_s + offset_s + drift_ppm * 1e-6 * (device_s - 2.0)

    device_s = np.arange(800, dtype=np.float64) * 0.005
    receive_s = np.maximum.accumulate(to_host(device_s) + 0.0003 + rng.exponential(jitter_s + 1e-9, 800))
    received_s = np.round(np.arange(200) * 0.02 + 0.001, 6)
    sent_s = to_host(received_s) - 0.0002 - rng.exponential(jitter_s + 1e-9, 200)
    in_force = np.searchsorted(received_s, device_s, side="right") - 1
    age_s = np.where(in_force >= 0, device_s - received_s[in_force], np.nan)
    empty = np.zeros((800, 1))
    commands = np.zeros((200, 1))
    trajectory = Trajectory(
        ("cart",),
        ("cart",),
        receive_s,
        device_s,
        empty,
        empty,
        empty,
        np.zeros(800, dtype=np.int64),
        in_force,
        age_s,
        sent_s,
        np.arange(200),
        commands,
        commands,
        commands,
        commands,
        commands,
        commands,
    )
    sync = synchronize(trajectory)
    assert sync.jumps == ()
    assert abs(sync.drift_ppm - drift_ppm) <= sync.drift_uncertainty_ppm + 1e-6
    # At another drift within its range the offset at the reference moves by less than the two uncertainties.
    slack_s = sync.drift_uncertainty_ppm * 1e-6 * 2.0
    truth_s = offset_s + drift_ppm * 1e-6 * (sync.reference_s - 2.0)
    assert abs(sync.offset_s - truth_s) <= sync.offset_uncertainty_s + slack_s + 1e-6
    first_s = device_s[0] + sync.offset_s + sync.drift_ppm * 1e-6 * (device_s[0] - sync.reference_s)
    np.testing.assert_allclose(first_s, to_host(device_s[:1])[0], atol=0.02)


def test_without_commands_only_one_side_is_known(make_trajectory: MakeTrajectory) -> None:
    """The offset then holds the smallest delay, 0.4 ms, and its uncertainty is unknown (null in JSON)."""
    sync = synchronize(make_trajectory(command_sequence=np.full(800, -1), command_age_s=np.full(800, np.nan)))
    assert sync.offset_s == pytest.approx(0.4e-3 + 2e-6)
    assert sync.to_json()["offset_uncertainty_s"] is None
    assert sync.to_json()["drift_uncertainty_ppm"] is None


def test_command_bounds_by_hand(make_trajectory: MakeTrajectory) -> None:
    """Command n, sent at 20 n ms, is received 1 ms later: the bound is -1 ms (and 2 us of slack)."""
    received_s, difference_s = command_bounds(make_trajectory())
    np.testing.assert_allclose(received_s, 0.02 * np.arange(200) + 0.001, atol=1e-9)
    np.testing.assert_allclose(difference_s, -1.002e-3, atol=1e-9)


def test_number_of_an_earlier_session_is_not_taken_for_ours(make_trajectory: MakeTrajectory) -> None:
    """A device that still reports command 150 of last time, a minute old, does not shift the bounds."""
    sound = make_trajectory()
    in_force, age_s = sound.command_sequence.copy(), sound.command_age_s.copy()
    in_force[:40], age_s[:40] = 150, 60.0 + sound.device_s[:40]
    sync = synchronize(replace(sound, command_sequence=in_force, command_age_s=age_s))
    assert sync.offset_s == pytest.approx(-0.3e-3, abs=1e-6)


@pytest.mark.parametrize("size_s", [0.02, -0.02, 1.5, -1.5])
def test_a_clock_that_is_set_is_found(make_trajectory: MakeTrajectory, size_s: float) -> None:
    """The device's clock is set by 20 ms or 1.5 s at sample 500; the estimate uses the samples before."""
    sound = make_trajectory()
    device_s = sound.device_s.copy()
    device_s[500:] -= size_s
    sync = synchronize(replace(sound, device_s=device_s))
    (jump,) = sync.jumps
    assert jump.index == 500
    assert jump.size_s == pytest.approx(size_s, abs=1e-9)
    assert sync.offset_s == pytest.approx(-0.3e-3, abs=1e-6)


def test_late_samples_are_no_jump(make_trajectory: MakeTrajectory) -> None:
    """A host that sleeps for 0.3 s gets the samples late and all at once; no clock was set."""
    sound = make_trajectory()
    receive_s = sound.receive_s.copy()
    receive_s[300:360] = receive_s[360]
    assert find_jumps(sound.device_s, receive_s - sound.device_s) == ()


def test_late_samples_beside_a_jump_leave_one_jump(make_trajectory: MakeTrajectory) -> None:
    """Lateness a second before a jump is not mistaken for it."""
    sound = make_trajectory()
    receive_s, device_s = sound.receive_s.copy(), sound.device_s.copy()
    receive_s[300:320] = receive_s[320]
    device_s[500:] += 0.05
    (jump,) = find_jumps(device_s, receive_s - device_s)
    assert (jump.index, round(jump.size_s, 6)) == (500, -0.05)


def test_stamps_taken_after_the_write_are_forgiven(make_trajectory: MakeTrajectory) -> None:
    """Sending stamps 2 ms too late contradict the states by 0.6 ms; such a stamp was taken late."""
    sound = make_trajectory()
    sync = synchronize(replace(sound, sent_s=sound.sent_s + 0.002))
    assert abs(sync.offset_s) < 1e-3


def test_contradicting_stamps_are_refused(make_trajectory: MakeTrajectory) -> None:
    """Every second sample arrives within 0.4 ms, yet commands seem to be received 11 ms before being sent."""
    sound = make_trajectory()
    receive_s = sound.receive_s + np.where(np.arange(800) % 2, 0.012, 0.0)
    with pytest.raises(InsufficientDataError, match="contradict each other"):
        synchronize(replace(sound, sent_s=sound.sent_s + 0.012, receive_s=receive_s))


def test_one_sample_is_too_few(make_trajectory: MakeTrajectory) -> None:
    """Two clocks cannot be related by one sample."""
    sound = make_trajectory()
    with pytest.raises(InsufficientDataError, match="at least 2"):
        synchronize(replace(sound, device_s=sound.device_s[:1], receive_s=sound.receive_s[:1]))
