"""The set-point generator: hand-computed slews and delays, and the laws they obey."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.sim.laws.setpoints import delay, play, slew


def test_slew_by_hand() -> None:
    """From 0 to 0.25 at 0.1 a step: 0.1, 0.2, 0.25, and back to 0 from there: 0.15, 0.05, 0."""
    target = np.array([0.25, 0.25, 0.25, 0.0, 0.0, 0.0])[:, None]
    path = slew(np.zeros((1, 1)), target, np.full((1, 1), 0.1))
    np.testing.assert_allclose(path[0, :, 0], [0.1, 0.2, 0.25, 0.15, 0.05, 0.0], atol=1e-15)


def test_members_slew_at_their_own_rates() -> None:
    """Two members, 0.1 and 0.3 a step, to 0.3."""
    path = slew(np.zeros((2, 1)), np.full((3, 1), 0.3), np.array([[0.1], [0.3]]))
    np.testing.assert_allclose(path[:, :, 0], [[0.1, 0.2, 0.3], [0.3, 0.3, 0.3]])


def test_delay_by_hand() -> None:
    """Two whole steps, and one and a half: half of the value one step ago and half of that two steps ago."""
    path = np.array([1.0, 2.0, 3.0, 4.0])[None, :, None].repeat(2, axis=0)
    late = delay(path, np.array([2.0, 1.5]), np.zeros((2, 1)))
    np.testing.assert_allclose(late[:, :, 0], [[0.0, 0.0, 1.0, 2.0], [0.0, 0.5, 1.5, 2.5]])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 12), st.integers(0, 10))
def test_the_last_steps_of_a_delay_are_those_of_all(seed: int, longest: int, last: int) -> None:
    """Bit for bit, whether the latencies reach before the first step or not, whole ones or not."""
    rng = np.random.default_rng(seed)
    path, before = rng.normal(size=(3, 10, 2)), rng.normal(size=(3, 2))
    for latency in (rng.uniform(0, longest, 3), rng.integers(0, longest + 1, (3, 2)).astype(float)):
        whole = delay(path, latency, before)
        np.testing.assert_array_equal(delay(path, latency, before, last), whole[:, 10 - last :])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 20))
def test_delaying_the_target_delays_the_setpoint(seed: int, steps: int) -> None:
    """A whole-step latency on the target and on the set-point are the same thing."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1, 1, 8).repeat(10)[:, None]
    late_target = np.concatenate([np.zeros((steps, 1)), target])[: len(target)]
    rate, start = np.full((1, 1), 0.07), np.zeros((1, 1))
    direct = slew(start, late_target, rate)
    shifted = delay(slew(start, target, rate), np.array([float(steps)]), start)
    np.testing.assert_allclose(direct, shifted, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.booleans())
def test_slew_is_the_step_by_step_law(seed: int, steps: int, limited: bool) -> None:
    """The closed form between changes equals moving by at most the rate at each step."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1, 1, (3, steps, 2)).round(1)
    rate = rng.choice([0.02, 0.1, 0.5] if limited else [3.0, np.inf], (3, steps, 2))
    start = rng.uniform(-1, 1, (3, 2))
    now, want = start, []
    for k in range(steps):
        now = now + np.clip(target[:, k] - now, -rate[:, k], rate[:, k])
        want.append(now)
    np.testing.assert_allclose(slew(start, target, rate), np.stack(want, axis=1), atol=1e-12)


def test_play_by_hand() -> None:
    """0.2 of play around 0: up to 0.1 nothing moves, then the end 0.1 behind; back only after 0.2."""
    path = np.array([0.05, 0.1, 0.3, 0.2, 0.1, 0.0, -0.2])[None, :, None]
    out = play(np.zeros((1, 1)), path, np.full((1, 1), 0.2))
    np.testing.assert_allclose(out[0, :, 0], [0, 0, 0.2, 0.2, 0.2, 0.1, -0.1], atol=1e-15)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 0.5))
def test_play_holds_until_it_is_used_up(seed: int, width: float) -> None:
    """What comes out is at most half the width behind, and moves only where it is just that."""
    rng = np.random.default_rng(seed)
    path, widths = rng.uniform(-1, 1, (2, 40, 3)), np.full((2, 3), width)
    start = path[:, 0]
    out = play(start, path, widths)
    behind = np.abs(path - out)
    assert np.all(behind <= width / 2 + 1e-12)
    moved = np.abs(np.diff(np.concatenate([start[:, None], out], axis=1), axis=1)) > 1e-12
    np.testing.assert_allclose(behind[moved], width / 2, atol=1e-12)
