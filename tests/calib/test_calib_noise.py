"""Noise of a recording, estimated from it alone: white noise, rounding, and jitter of the sample times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from deal_hw.calib.data.noise import HELD_STD, noise_model, white_noise_std
from deal_hw.types import FloatArray


def test_white_noise_is_measured_under_motion() -> None:
    """0.3 mm of noise on a 5 cm swing at 1 Hz is found within 15 %."""
    t = np.arange(800) * 5e-3
    values = 0.05 * np.sin(2 * np.pi * t)[:, None] + np.random.default_rng(0).normal(0, 3e-4, (800, 1))
    assert white_noise_std([values])[0] == pytest.approx(3e-4, rel=0.15)


def test_what_was_filled_in_is_not_taken_for_quiet_samples() -> None:
    """Lost samples get a spline, which has no noise: with one in twelve lost it looked a quarter less."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 60, 0.005)
    values = (0.1 * np.sin(6.0 * t) + 3e-4 * rng.standard_normal(t.size))[:, None]
    reported = np.ones(t.size, dtype=bool)
    reported[5:-5:12] = False
    values[~reported] = CubicSpline(t[reported], values[reported])(t[~reported])
    assert white_noise_std([values])[0] < 0.9 * 3e-4
    assert white_noise_std([values], reported=[reported])[0] == pytest.approx(3e-4, rel=0.1)


def _encoder(seconds: float, rest_s: float = 0.0) -> FloatArray:
    """Return a swing of a 12-bit encoder with 2 mrad of noise at 50 Hz, (T, 1), after a rest."""
    t = np.arange(-rest_s, seconds, 0.02)
    motion = 2.5 * np.sin(2 * np.pi * 0.9 * np.maximum(t, 0.0))
    noise = np.random.default_rng(3).normal(0, 2e-3, t.size) * (t >= 0)
    count = 2 * np.pi / 4096
    return np.asarray(np.round((motion + noise) / count) * count)[:, None]


@given(st.lists(st.integers(1, 1999), min_size=1, max_size=12, unique=True))
def test_cutting_a_recording_changes_its_noise_by_little(cuts: list[int]) -> None:
    """Each cut loses six differences of 2000, whatever the shortest part: less than a tenth in all."""
    values = _encoder(40.0)
    parts = np.split(values, sorted(cuts))
    whole = white_noise_std([values])[0]
    assert whole == pytest.approx(np.hypot(2e-3, 2 * np.pi / 4096 / np.sqrt(12)), rel=0.1)
    assert white_noise_std(parts)[0] == pytest.approx(whole, rel=0.1)
    speeds = [np.gradient(values[:, 0], 0.02)[:, None]]
    model = noise_model([values], speeds)
    divided = noise_model(parts, np.split(speeds[0], sorted(cuts)))
    assert divided.position_std[0] == pytest.approx(model.position_std[0], rel=0.2)


def test_a_part_of_a_fast_motion_does_not_tell_the_rounding() -> None:
    """Twenty samples of a fast swing lie 80 counts apart or more, which is no rounding."""
    values = _encoder(10.0)
    parts = np.split(values, (18, 38))
    assert np.min(np.diff(np.unique(parts[1]))) > 80 * 2 * np.pi / 4096
    assert white_noise_std(parts)[0] == pytest.approx(white_noise_std([values])[0], rel=0.1)


def test_a_joint_at_rest_has_no_vote() -> None:
    """A joint held on one count of its encoder for a minute shows no noise; its swing of 10 s does."""
    moved, held = _encoder(10.0), _encoder(0.0, rest_s=60.0)
    assert np.ptp(held) == 0
    found = white_noise_std([moved])[0]
    assert white_noise_std([held, moved])[0] == found
    assert white_noise_std([_encoder(10.0, rest_s=60.0)])[0] == pytest.approx(found, rel=0.1)
    # Alone it shows nothing: it has the noise of a coarse encoder.
    assert white_noise_std([held])[0] == HELD_STD


def test_a_resampled_recording_keeps_its_rounding() -> None:
    """A slow servo, 12 bits a turn, on an uneven clock: resampling makes values between its counts."""
    rng = np.random.default_rng(0)
    clock = np.cumsum(rng.normal(5.3e-3, 1e-4, 2200))
    turn, count = np.sin(2 * np.pi * 0.1 * clock), 2 * np.pi / 4096
    counted = np.round(0.4 * turn / count) * count
    even = np.arange(clock[0], clock[-1], 5.375e-3)
    position = np.interp(even, clock, counted)[:, None]
    rounding = count / np.sqrt(12.0)
    assert np.min(np.diff(np.unique(position))) < 0.1 * count
    found = noise_model([position], [np.gradient(position, even, axis=0)])
    assert 0.99 * rounding < found.position_std[0] < 1.5 * rounding
    assert white_noise_std([position])[0] >= 0.99 * rounding
    # A sensor without counts is no finer for it.
    smooth = (turn + 1e-3 * rng.standard_normal(len(turn)))[:, None]
    assert white_noise_std([smooth])[0] == pytest.approx(1e-3, rel=0.1)


def test_timing_jitter_is_told_from_noise() -> None:
    """Samples off by up to 2 ms (std 0.816 ms) beside 1 mrad of noise are found, and none where none is."""
    rng = np.random.default_rng(1)
    t = np.arange(1600, dtype=np.float64) * 5e-3

    def swing(at: FloatArray) -> FloatArray:
        return np.asarray(1.5 * np.sin(2 * np.pi * 0.8 * at))

    speed = (1.5 * 2 * np.pi * 0.8 * np.cos(2 * np.pi * 0.8 * t))[:, None]
    jitter = rng.integers(0, 3, t.size) * 1e-3
    noise = rng.normal(0, 1e-3, t.size)
    found = noise_model([(swing(t - jitter) + noise)[:, None]], [speed])
    assert found.timing_std_s == pytest.approx(0.816e-3, rel=0.25)
    assert found.position_std[0] == pytest.approx(1e-3, rel=0.4)
    still = noise_model([(swing(t) + noise)[:, None]], [speed])
    assert still.timing_std_s == 0.0
    assert found.std(np.array([2.0]))[0] == pytest.approx(
        np.hypot(found.position_std[0], 2 * found.timing_std_s)
    )


def test_rounding_of_an_encoder_is_no_jitter() -> None:
    """4096 counts a turn round to 1.53 mrad: 0.44 mrad of noise. Slow parts stay on one count."""
    t = np.arange(1600, dtype=np.float64) * 5e-3
    count = 2 * np.pi / 4096
    phase = 2 * np.pi * 0.4 * t
    motion, speed = 1.5 * np.sin(phase) ** 3, 1.5 * 3 * np.sin(phase) ** 2 * np.cos(phase) * 2 * np.pi * 0.4
    found = noise_model([(np.round(motion / count) * count)[:, None]], [speed[:, None]])
    assert found.timing_std_s < 1e-5
    assert found.position_std[0] == pytest.approx(count / np.sqrt(12), rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_saw_tooth_of_slow_motion_is_no_jitter(seed: int) -> None:
    """Three joints with 12 bits a turn, less than a count a sample, exact stamps: 4 to 5 ms were found."""
    rng = np.random.default_rng(seed)
    t, count = np.arange(0, 28, 5e-3), 2 * np.pi / 4096
    frequency, size, phase = rng.uniform((0.1, 0.003, 0), (1.0, 0.017, 6.28), (3, 6, 3)).transpose(2, 0, 1)
    angle = 2 * np.pi * frequency[..., None] * t + phase[..., None]
    motion = np.sum(size[..., None] * np.sin(angle), axis=1).T
    speed = np.sum((2 * np.pi * frequency * size)[..., None] * np.cos(angle), axis=1).T
    found = noise_model([np.round(motion / count) * count], [speed])
    assert found.timing_std_s == 0.0
    assert found.position_std == pytest.approx(np.full(3, count / np.sqrt(12)), rel=0.3)


def _jittering(seed: int) -> tuple[FloatArray, FloatArray]:
    """Return 4 s of a swing at 200 Hz with 1 mrad of noise and samples up to 2 ms late, and its speed."""
    rng = np.random.default_rng(seed)
    t = np.arange(800) * 5e-3
    frequency, phase = rng.uniform(0.3, 1.0, 3), rng.uniform(0, 2 * np.pi, 3)
    late = t - rng.integers(0, 3, t.size) * 1e-3
    angle = np.sum(np.sin(2 * np.pi * np.outer(late, frequency) + phase), axis=1)
    speed = np.sum(2 * np.pi * frequency * np.cos(2 * np.pi * np.outer(t, frequency) + phase), axis=1)
    return (angle + 1e-3 * rng.standard_normal(t.size))[:, None], speed[:, None]


def test_a_short_recording_shows_its_noise_without_bias() -> None:
    """In the mean of 20, and to 6 %; medians alone scatter by 10 %, and are 3 % too small."""
    found = [noise_model([angle], [speed]) for angle, speed in map(_jittering, range(20))]
    jitter = np.array([f.timing_std_s for f in found]) / np.sqrt(2 / 3) * 1e3
    assert np.mean(jitter) == pytest.approx(1.0, abs=0.04) and np.std(jitter) < 0.08
    squared = np.array([f.std(np.array([3.0]))[0] ** 2 for f in found]) / (1e-6 + 9 * 2 / 3 * 1e-6)
    assert np.mean(squared) == pytest.approx(1.0, abs=0.08)


def test_impacts_are_no_noise() -> None:
    """One sample in fifty has an error of 20 times the noise, which reaches seven differences."""
    rng = np.random.default_rng(0)
    values = 1e-3 * rng.standard_normal((4000, 1))
    values[rng.choice(4000, 80, replace=False)] += 0.02
    assert white_noise_std([values])[0] == pytest.approx(1e-3, rel=0.25)
    assert np.std(values) > 2e-3
