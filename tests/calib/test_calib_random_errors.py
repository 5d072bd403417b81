"""Fits that allow for random errors of a model, and intervals that allow for commands that may jitter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.knee_evidence import PERIOD_S, SAMPLES, WINDOWS
from fakes.small_runs import small_run

from deal_hw.calib.data.noise import NoiseModel
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.window_data import WindowData
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, jitter_alarm, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined
from deal_hw.calib.fit.residual import Shooting, WindowRows
from deal_hw.calib.hypotheses import random_errors
from deal_hw.calib.hypotheses.random_delay import DelaysAsked, PossibleDelays, fit_delays
from deal_hw.calib.hypotheses.random_errors import (
    ComparedErrors,
    LikelyErrors,
    SeenErrors,
    fit_errors,
    whitened_for,
)
from deal_hw.calib.hypotheses.signatures import SignatureResponse
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.calib.pipeline.calibration_run import CalibrationRun
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.validation.settings import Validation
from deal_hw.sim.recordings.windows import Windows
from deal_hw.types import FloatArray


def _moved(impulse: FloatArray) -> FloatArray:
    """Return the motion of a joint that impulses move, (W, H)."""
    time = np.arange(SAMPLES) * PERIOD_S
    answer = 50 * time * np.exp(-20 * time)
    return np.stack([np.convolve(one, answer)[:SAMPLES] for one in impulse])


def _pushed(force: float, seed: int, hertz: float = 0.7) -> tuple[SeenErrors, float]:
    """Return residuals that a fit of one value followed, and by how much the fit is off [its information].

    A random force of this standard deviation changes over 0.1 s; the value's effect is a slow swing.
    """
    rng = np.random.default_rng(seed)
    change = np.sin(2 * np.pi * hertz * np.arange(WINDOWS * SAMPLES) * PERIOD_S).reshape(WINDOWS, SAMPLES)
    apart = np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES))) * PERIOD_S
    root = np.linalg.cholesky(np.exp(-apart / 0.1) + 1e-9 * np.eye(SAMPLES))
    residual = rng.normal(size=(WINDOWS, SAMPLES))
    residual += force * _moved(rng.standard_normal((WINDOWS, SAMPLES)) @ root.T)
    by_value = _moved(change)
    # The fit, with a start state in each window.
    free = by_value - by_value.mean(axis=1, keepdims=True)
    off = float(np.sum(free * residual) / np.sum(free**2))
    left = residual - off * by_value
    last = ((0, 0), (0, 1))
    rows = WindowRows(
        np.pad(left - left.mean(axis=1, keepdims=True), last),
        np.pad(by_value, last)[..., None],
        np.concatenate([np.ones((WINDOWS, SAMPLES, 1)), np.full((WINDOWS, 1, 1), 1e-3)], axis=1),
    )
    response = np.broadcast_to(_moved(np.eye(1, SAMPLES))[0], (1, WINDOWS, SAMPLES))[..., None]
    seen = SeenErrors([rows], [SignatureResponse(response, change[..., None])], [PERIOD_S])
    return seen, off * float(np.sqrt(np.sum(free**2)))


def _least_variance(seen: SeenErrors, likely: LikelyErrors) -> tuple[float, float]:
    """Return the step from a fit to that of least variance, and its standard deviation [1 / information]."""
    windows = seen.whole()
    assert windows is not None
    unit = np.eye(SAMPLES)
    information, score, plain = 0.0, 0.0, 0.0
    for window in windows:
        effects = [
            np.sqrt(size / likely.covariances[name].intensity) * window.effects(name) @ window.basis
            for name, size in likely.found.sizes.items()
        ]
        V = np.eye(len(window.residual)) + sum((e.T @ e for e in effects), 0 * unit[:1, :1])
        j = window.parameter[:, 0]
        information += float(j @ np.linalg.solve(V, j))
        score += float(j @ np.linalg.solve(V, window.residual))
        plain += float(j @ j)
    return -score / information * np.sqrt(plain), np.sqrt(likely.found.level * plain / information)


def test_a_fit_that_allows_for_slow_forces_is_nearer_and_knows_how_near() -> None:
    """With white noise alone both would be off by 1 in these units; 16 draws."""
    plain, off, std = [], [], []
    for seed in range(16):
        seen, by = _pushed(0.1, seed, hertz=4.0)
        likely = LikelyErrors.of(ComparedErrors.of(seen))
        assert likely.gain > EVIDENCE
        step, own = _least_variance(seen, likely)
        plain.append(by)
        off.append(by - step)
        std.append(own)
    rms, after = (float(np.sqrt(np.mean(np.square(each)))) for each in (plain, off))
    assert rms > 3
    assert after < 0.75 * rms
    assert np.mean(std) == pytest.approx(after, rel=0.35)


def test_white_noise_has_no_random_errors() -> None:
    """Nothing is likelier than white noise, beyond chance."""
    for seed in range(5):
        seen, _ = _pushed(0.0, seed)
        assert LikelyErrors.of(ComparedErrors.of(seen)).gain < EVIDENCE


def test_whitened_windows_leave_unit_covariance() -> None:
    """W V W^T is the unit matrix, with V by the processes' effects and W as a window applies it."""
    seen, _ = _pushed(0.1, 0)
    likely, windows = LikelyErrors.of(ComparedErrors.of(seen)), seen.whole()
    assert windows is not None
    data = WindowData(
        episode=0,
        windows=Windows(np.arange(WINDOWS) * SAMPLES, SAMPLES, 1),
        measured=np.zeros((WINDOWS, SAMPLES, 1)),
        std=np.full((WINDOWS, SAMPLES, 1), 2.0),
        start_position=np.zeros((WINDOWS, 1)),
        start_velocity=np.zeros((WINDOWS, 1)),
        prior_mean=np.zeros((WINDOWS, 2)),
        prior_std=np.ones((WINDOWS, 2)),
        prior_counts=np.ones(2, dtype=bool),
    )
    (found,) = whitened_for([data], windows, likely.found, likely.covariances)
    unit = np.eye(SAMPLES).reshape(SAMPLES, 1, SAMPLES, 1) * np.ones((1, WINDOWS, 1, 1))
    white = found.whitened(2.0 * unit).reshape(SAMPLES, WINDOWS, SAMPLES)
    for w, window in enumerate(windows):
        V = np.eye(SAMPLES)
        for name, size in likely.found.sizes.items():
            effects = window.effects(name)
            V += size / likely.covariances[name].intensity * effects.T @ effects
        W = white[:, w]
        assert np.abs(V - np.eye(SAMPLES)).max() > 0.5
        # Directions whose variance is a thousandth of the noise's are left alone.
        np.testing.assert_allclose(W @ V @ W.T, np.eye(SAMPLES), atol=2e-3)


def test_a_fit_that_allows_for_errors_is_that_of_least_squares_without_any(
    noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """A right model, whose residual is white: values within their standard deviation, intervals as wide."""
    found = fit_errors(noisy_refined)
    assert found is not None and found.fit.chi2 < MISMATCH_CHI2
    assert found.before is noisy_refined and sum(found.errors.shares.values()) < 0.1
    plain = uncertainty_at(noisy_problem, with_rows(noisy_refined))
    std, scale = np.sqrt(np.diag(plain.covariance)), noisy_problem.space.to_scale
    assert np.all(np.abs(scale(found.fit.theta) - scale(noisy_refined.theta)) < std)
    known = found.widened(uncertainty_at(noisy_problem, with_rows(found.fit)), found.fit.latency_s)
    assert np.all(np.diag(known.covariance) >= np.diag(plain.covariance) * (1 - 1e-9))


def test_a_fit_with_too_many_residuals_stays_as_it_is(
    noisy_refined: Refined, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their covariances would take more memory than a computer has."""
    monkeypatch.setattr(random_errors, "MOST_WHITENED", 1000)
    assert fit_errors(noisy_refined) is None


def test_a_residual_that_comes_in_bursts_is_no_random_error(noisy_refined: Refined) -> None:
    """A recording that begins with a command under way: a process would be as large at all times."""
    first, *others = noisy_refined.normal.residual
    burst = first.copy()
    burst[0, :5] += 30.0
    normal = dataclasses.replace(noisy_refined.normal, residual=(burst, *others))
    assert fit_errors(dataclasses.replace(noisy_refined, normal=normal)) is None


def test_the_ratio_of_variances_by_hand() -> None:
    """A value with information 8, a prior of 2 and a score's variance of 98: (98 + 2) / 10."""
    possible = PossibleDelays(1e-3, np.diag([8.0, 1.0]), np.diag([98.0, 1.0]))
    np.testing.assert_allclose(possible.ratio(np.array([2.0, 1.0])), [10.0, 1.0])
    # A given value does not move, and moves no other one.
    both = PossibleDelays(1e-3, np.array([[8.0, 3.0], [3.0, 2.0]]), np.array([[98.0, 3.0], [3.0, 200.0]]))
    np.testing.assert_allclose(both.ratio(np.array([2.0, np.inf])), [10.0, 1.0])


def _with_jitter(problem: Problem, std_s: float) -> Problem:
    """Return the problem as if its sample times jittered, with the noise that it has."""
    return problem.sharing(noise=NoiseModel(problem.noise.position_std, std_s))


def test_commands_may_jitter_as_much_as_the_residual_leaves_possible(
    noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """Nothing is asked where sample times do not jitter. Where they do, a right fit rules most of it out."""
    assert noisy_problem.noise.timing_std_s == 0.0
    assert fit_delays(noisy_problem, noisy_refined, EVIDENCE) == DelaysAsked()
    little = fit_delays(_with_jitter(noisy_problem, 1.5e-4), noisy_refined, EVIDENCE)
    much = fit_delays(_with_jitter(noisy_problem, 2e-3), noisy_refined, EVIDENCE)
    assert little.possible is not None and little.possible.std_s == 1.5e-4
    assert much.possible is not None and 1.5e-4 < much.possible.std_s < 1e-3
    assert much.found is None and not much.correlated


def test_intervals_hold_commands_that_may_jitter(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Their variance is the ratio times that of white noise; the alarm says that they are allowed for."""
    problem, fit = _with_jitter(noisy_problem, 1.5e-4), with_rows(noisy_refined)
    fit = dataclasses.replace(fit, shooting=Shooting(problem, fit.shooting.length))
    known = uncertainty_at(problem, fit)
    asked = fit_delays(problem, fit, EVIDENCE)
    wider = asked.widened(known, fit, fixed_latency=False)
    grown = np.diag(wider.covariance) / np.diag(known.covariance)
    assert np.all(grown >= 1 - 1e-9) and np.max(grown) > 1.2
    assert np.ptp(wider.latency_interval_s) >= np.ptp(known.latency_interval_s)
    assert jitter_alarm(1.5e-4) in known.alarms and jitter_alarm(1.5e-4) not in wider.alarms
    assert any("Commands may jitter as much: the intervals allow" in alarm.means for alarm in wider.alarms)
    given = asked.widened(known, fit, fixed_latency=True)
    assert given.latency_interval_s == known.latency_interval_s


@pytest.mark.parametrize("wrong", [False, True])
def test_a_calibration_ends_with_the_fit_that_allows_for_errors(
    wrong: bool, noisy_problem: Problem, noisy_refined: Refined, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chi2 stays that of least squares. Errors that weights allow for are not allowed for twice."""
    problem = _with_jitter(noisy_problem, 1.5e-4)
    settings = Validation(split_half=False, physics_step=False, diagnosis=False)
    run = small_run(problem, settings=settings)
    monkeypatch.setattr(CalibrationRun, "random_delays", lambda *_: DelaysAsked(correlated=True))
    fit = dataclasses.replace(noisy_refined, shooting=Shooting(problem, noisy_refined.shooting.length))
    found = conclude_fit(run, None, fit, wrong=wrong)
    assert found.chi2 == fit.chi2
    taken = [row["explanation"] for row in found.facts.get("candidates", [])]
    if wrong:
        assert np.array_equal(found.theta, fit.theta)
        assert "random_errors" not in found.facts and not taken
    else:
        assert not np.array_equal(found.theta, fit.theta)
        assert set(found.facts["random_errors"]) == {"white", "slow", "slow delay", "delay"}
        assert taken == ["random forces and late commands"]
        assert any("the fit allows for random errors" in alarm.means for alarm in found.known.alarms)
