"""The task's metrics, against numbers computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fakes.linear_policy import CARTPOLE_GAINS, feedback_spec

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.motions.scores.balance import balance_result, wrapped_angle
from deal_hw.policies.evaluate import evaluate_batch
from deal_hw.policies.servo_loop import EXACT_SENSOR
from deal_hw.policy import Observation
from deal_hw.types import FloatArray

SPACE = k9_space()


class Feedback:
    """State feedback for many members at once."""

    spec = feedback_spec(DESCRIPTION)

    def __init__(self, gain: float = 1.0) -> None:
        self._gains = gain * np.array(CARTPOLE_GAINS)[:, None] / self.spec.action_scale[0]

    def act_batch(self, observations: Observation) -> FloatArray:
        """Return the actions, (B, 1)."""
        return np.asarray(observations @ self._gains, dtype=float)


def test_metrics_by_hand() -> None:
    """|angles| 0.1, 0.2, 0, 0.1 and |speeds| 1, 0, 0, 2: means 0.1 and 0.75."""
    position = np.array([[0.0, 0.1], [0.0, -0.2], [0.0, 0.0], [0.0, 0.1]])
    velocity = np.array([[1.0, 5.0], [0.0, 5.0], [0.0, 5.0], [-2.0, 5.0]])
    result = balance_result(position, velocity, 0.02)
    assert result.angle_error_rad == pytest.approx(0.1)
    assert result.cart_speed_m_s == pytest.approx(0.75)
    assert not result.fell
    assert result.upright_s == pytest.approx(0.08)


def test_a_fallen_pole_counts_with_what_is_left_to_upright() -> None:
    """After one and a half turns the pole hangs: pi, not 3 pi; it was upright for two samples."""
    position = np.array([[0.0, 0.0], [0.0, 0.4], [0.0, 0.6], [0.0, 3 * math.pi]])
    result = balance_result(position, np.zeros((4, 2)), 0.02)
    assert result.fell
    assert result.upright_s == pytest.approx(0.04)
    assert result.angle_error_rad == pytest.approx((0.0 + 0.4 + 0.6 + math.pi) / 4)


def test_a_run_that_was_ended_counts_to_its_end() -> None:
    """0.2 s of 0.1 rad at 1 m/s, then 0.8 s hanging at rest: 0.2 * 0.1 + 0.8 * pi, and 0.2 m/s."""
    position, velocity = np.tile([0.3, 0.1], (10, 1)), np.tile([1.0, 0.0], (10, 1))
    result = balance_result(position, velocity, 0.02, duration_s=1.0)
    assert result.angle_error_rad == pytest.approx(0.2 * 0.1 + 0.8 * math.pi)
    assert result.cart_speed_m_s == pytest.approx(0.2)
    assert result.fell
    assert result.upright_s == pytest.approx(0.2)
    whole = balance_result(position[:9], velocity[:9], 0.02, duration_s=0.2)
    assert whole.angle_error_rad == pytest.approx(0.1)
    assert not whole.fell


def test_angles_are_taken_modulo_a_turn() -> None:
    """Upright is upright after any number of turns."""
    np.testing.assert_allclose(
        wrapped_angle(np.array([0.1, 2 * math.pi + 0.1, -4 * math.pi - 0.1, 3.5])),
        [0.1, 0.1, -0.1, 3.5 - 2 * math.pi],
    )


def test_batched_evaluation_tells_who_balances() -> None:
    """A known good feedback balances the nominal robot from both sides; doing nothing lets it fall."""
    theta, latency = np.repeat(SPACE.nominal[None], 2, axis=0), np.full(2, 0.005)
    start = np.array([[0.0, 0.04], [0.0, -0.04]])
    rng = np.random.default_rng(0)
    good, bad = (
        evaluate_batch(
            Feedback(gain),
            DESCRIPTION,
            SPACE,
            theta,
            latency,
            rng,
            seconds=3.0,
            start_position=start,
            sensor=EXACT_SENSOR,
        )
        for gain in (1.0, 0.0)
    )
    assert [r.fell for r in good] == [False, False]
    assert [r.fell for r in bad] == [True, True]
    assert max(r.angle_error_rad for r in good) < 0.04 < min(r.angle_error_rad for r in bad)


def test_a_robot_whose_physics_diverges_has_fallen() -> None:
    """It reports the home pose, as if it balanced perfectly; it counts as a hanging pole."""
    (lost,) = evaluate_batch(
        Feedback(),
        DESCRIPTION,
        SPACE,
        SPACE.nominal[None],
        np.array([0.005]),
        np.random.default_rng(0),
        seconds=0.2,
        start_position=np.array([[0.0, np.nan]]),
        sensor=EXACT_SENSOR,
    )
    assert lost.fell and lost.upright_s == 0.0 and lost.angle_error_rad == pytest.approx(math.pi)
