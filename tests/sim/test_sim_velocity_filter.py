"""Velocity and height of a base from its accelerometer and the feet that stand."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.rotations import rotated
from deal_hw.sim.legged.leg_odometry import smoothed_height
from deal_hw.sim.legged.velocity_filter import GRAVITY, filtered_velocity, standing_feet

STEP_S = 0.002


@pytest.fixture
def time_s() -> np.ndarray:
    """Two seconds of samples."""
    return np.arange(1000) * STEP_S


def test_vectors_turn_with_the_base() -> None:
    """A quarter turn about z takes x to y, and leaves z."""
    quarter = np.tile([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], (2, 1))
    turned = rotated(quarter, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(turned, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


def test_feet_that_bear_enough_stand() -> None:
    """A swinging leg looks like some Newton; in the air all feet together bear too little."""
    load = np.array([[75.0, 10.0, 5.0, 72.0], [12.0, 8.0, -5.0, 3.0], [37.0, 37.0, 36.0, 38.0]])
    stands = standing_feet(load, 150.0)
    assert stands.tolist() == [[True, False, False, True], [False] * 4, [True] * 4]


def test_a_foot_that_slides_hardly_moves_the_answer(time_s: np.ndarray) -> None:
    """Feet say 1 m/s; one of two says 0 for 20 ms at each landing, as sliding ones do."""
    answers = np.tile([1.0, 0.0, 0.0], (1000, 2, 1))
    answers[np.arange(1000) % 200 < 10, 1] = 0.0
    stands = np.ones((1000, 2), dtype=bool)
    rest = np.tile(GRAVITY, (1000, 1))
    found = filtered_velocity(time_s, rest, answers, stands)
    np.testing.assert_allclose(found[200:, 0], 1.0, atol=0.05)
    # A mean of the feet would be off by half a metre a second there.
    assert np.abs(answers.mean(axis=1)[200:, 0] - 1.0).max() == pytest.approx(0.5)


def test_the_accelerometer_carries_on_while_no_foot_stands(time_s: np.ndarray) -> None:
    """From 0 at 2 m/s² for 0.2 s in the air: 0.4 m/s, which the feet confirm afterwards."""
    pushed = np.tile(GRAVITY, (1000, 1))
    pushed[400:500, 0] += 2.0
    true = np.clip((np.arange(1000) - 400) * STEP_S * 2.0, 0.0, 0.4)
    answers = np.zeros((1000, 1, 3))
    answers[:, 0, 0] = true
    stands = np.ones((1000, 1), dtype=bool)
    stands[400:500] = False
    found = filtered_velocity(time_s, pushed, answers, stands)
    np.testing.assert_allclose(found[:, 0], true, atol=0.02)


@pytest.mark.parametrize("lost", [False, True])
def test_height_and_accelerometer_give_the_vertical_velocity(time_s: np.ndarray, lost: bool) -> None:
    """A trot of 10 mm at 4 Hz; heights with 3 mm of noise, missing for a fifth of each step.

    The accelerometer is off by 0.05 m/s². With ``lost`` a tenth of the samples is missing.
    """
    rng = np.random.default_rng(0)
    if lost:
        time_s = time_s[np.sort(rng.choice(len(time_s), 900, replace=False))]
    turn = 2 * np.pi * 4.0
    height, speed = 0.3 + 0.01 * np.sin(turn * time_s), 0.01 * turn * np.cos(turn * time_s)
    felt = GRAVITY[2] + 0.05 - 0.01 * turn**2 * np.sin(turn * time_s)
    felt = felt + 0.3 * rng.standard_normal(len(time_s))
    seen = height + 0.003 * rng.standard_normal(len(time_s))
    seen[(4.0 * time_s) % 1.0 < 0.2] = np.nan
    found, velocity = smoothed_height(time_s, felt, seen)
    assert np.abs(found - height)[100:-100].max() < 2e-3
    assert np.abs(velocity - speed)[100:-100].max() < 0.015
    # What differences of the heights would give.
    assert np.nanstd(np.gradient(seen, time_s) - speed) > 0.5
