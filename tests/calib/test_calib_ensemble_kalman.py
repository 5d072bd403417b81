"""The ensemble Kalman step on linear problems, whose posterior is known in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deal_hw.calib.search.eki import EnsembleKalman


def test_tempered_ensemble_samples_the_linear_gaussian_posterior() -> None:
    """Prior N(0, I), y = A z + noise: a large ensemble has the exact posterior's mean and covariance."""
    rng = np.random.default_rng(1)
    A = rng.standard_normal((6, 3))
    y = A @ np.array([1.0, -2.0, 0.5]) + rng.standard_normal(6)
    kalman = EnsembleKalman(rng.standard_normal((4000, 3)), rng, step_clip=np.inf)
    steps = 0
    while not kalman.finished:
        kalman.tell(y - kalman.ask() @ A.T)
        steps += 1
    covariance = np.linalg.inv(A.T @ A + np.eye(3))
    mean = covariance @ A.T @ y
    assert steps > 1
    np.testing.assert_allclose(kalman.ask().mean(axis=0), mean, atol=0.04)
    np.testing.assert_allclose(np.cov(kalman.ask(), rowvar=False), covariance, atol=0.03)
    assert kalman.tempering == pytest.approx(1.0)


def test_single_step_by_hand() -> None:
    """One coordinate, members -1 and 1, prediction g = z, recording y = 3: with a = 1, gain 2 / (2 + 1)."""

    class NoNoise(np.random.Generator):
        def standard_normal(self, size: Any = None, dtype: Any = None, out: Any = None) -> Any:
            return np.zeros(size)

    kalman = EnsembleKalman(np.array([[-1.0], [1.0]]), NoNoise(np.random.PCG64(0)), step_clip=np.inf)
    # Sample variance of z and of g is 2. Misfits are 8 and 2: mean 5, variance 9; the controller allows
    # max(1/10, sqrt(1/18)) = 0.2357, so a = 4.243 and the gain is 2 / (2 + 4.243) = 0.32038.
    step = kalman.tell(np.array([[4.0], [2.0]]))
    assert step.inflation == pytest.approx(18**0.5)
    np.testing.assert_allclose(kalman.ask()[:, 0], [-1 + 4 * 0.320377, 1 + 2 * 0.320377], atol=1e-5)


def test_discrepancy_rule_leaves_the_asked_share() -> None:
    """With keep = 0.3 about 0.3 of a linear, noise-free problem's mean residual is left."""
    rng = np.random.default_rng(2)
    A = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    kalman = EnsembleKalman(rng.standard_normal((3000, 4)), rng, step_clip=np.inf)
    target = A @ np.full(4, 3.0)
    before = np.linalg.norm((target - kalman.ask() @ A.T).mean(axis=0))
    kalman.tell(target - kalman.ask() @ A.T, keep=0.3)
    after = np.linalg.norm((target - kalman.ask() @ A.T).mean(axis=0))
    # The inflation is the first power of two that keeps at least 0.3, so at most a little less than twice the
    # odds.
    assert 0.28 < after / before < 0.48
    assert not kalman.finished


def test_step_is_clipped() -> None:
    """No coordinate moves further than the clip in one step."""
    rng = np.random.default_rng(3)
    start = rng.standard_normal((20, 2))
    kalman = EnsembleKalman(start, rng, step_clip=0.5)
    kalman.tell(1e3 - start)
    assert np.abs(kalman.ask() - start).max() <= 0.5 + 1e-12


def test_diverged_members_restart_from_others() -> None:
    """Members without a finite residual do not poison the others and continue from one of them."""
    rng = np.random.default_rng(4)
    start = rng.standard_normal((30, 2))
    residual = 1.0 - start
    residual[:3] = np.nan
    kalman = EnsembleKalman(start, rng)
    kalman.tell(residual)
    assert np.isfinite(kalman.ask()).all()
    everyone = EnsembleKalman(start, rng)
    everyone.tell(np.full((30, 2), np.nan))
    np.testing.assert_array_equal(everyone.ask(), start)


def test_widening_keeps_the_mean_and_restarts_the_tempering() -> None:
    """The next stage starts from at least the asked spread; a wider coordinate stays as it is."""
    rng = np.random.default_rng(5)
    start = rng.standard_normal((200, 2)) * [0.01, 3.0]
    kalman = EnsembleKalman(start, rng)
    kalman.tempering = 1.0
    kalman.widen(0.5)
    np.testing.assert_allclose(kalman.ask().mean(axis=0), start.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(kalman.ask().std(axis=0, ddof=1), [0.5, start[:, 1].std(ddof=1)])
    assert not kalman.finished


def test_members_that_predict_alike_stay() -> None:
    """Without differences there is nothing to regress on, and nothing divides by zero."""
    start = np.random.default_rng(6).standard_normal((10, 2))
    for width in (0, 3):
        kalman = EnsembleKalman(start, np.random.default_rng(0))
        kalman.tell(np.ones((10, width)), keep=0.3)
        np.testing.assert_array_equal(kalman.ask(), start)
