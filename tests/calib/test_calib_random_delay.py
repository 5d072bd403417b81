"""Whether a residual looks like random delays of commands, or like anything else that is random."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from fakes.knee_evidence import PERIOD_S, SAMPLES, WINDOWS

from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.hypotheses.random_delay import random_delay
from deal_hw.calib.hypotheses.random_errors import (
    FEWEST_WINDOWS,
    Covariance,
    ErrorWindow,
    Process,
    SeenErrors,
)
from deal_hw.calib.hypotheses.signatures import SignatureResponse
from deal_hw.calib.hypotheses.thresholds import EVIDENCE
from deal_hw.types import FloatArray


def _pushed(
    varies: Callable[[FloatArray, np.random.Generator], FloatArray],
) -> SeenErrors:
    """Return residuals of a joint that impulses move, as ``varies`` makes them of what commands change."""
    rng = np.random.default_rng(3)
    time = np.arange(SAMPLES) * PERIOD_S
    answer = 50 * time * np.exp(-20 * time)
    change = np.sin(2 * np.pi * 0.7 * np.arange(WINDOWS * SAMPLES) * PERIOD_S).reshape(WINDOWS, SAMPLES)
    impulse = varies(change, rng)
    moved = np.stack([np.convolve(one, answer)[:SAMPLES] for one in impulse])
    residual = rng.normal(size=(WINDOWS, SAMPLES)) + moved
    rows = WindowRows(
        np.concatenate([residual, np.zeros((WINDOWS, 1))], axis=1),
        np.zeros((WINDOWS, SAMPLES + 1, 1)),
        np.concatenate([np.ones((WINDOWS, SAMPLES, 1)), np.full((WINDOWS, 1, 1), 1e-3)], axis=1),
    )
    response = np.broadcast_to(answer, (1, WINDOWS, SAMPLES))[..., None]
    return SeenErrors([rows], [SignatureResponse(response, change[..., None])], [PERIOD_S])


def test_random_delays_push_where_commands_change() -> None:
    """Impulses of 0.5 (standard deviation) times what each command changes: 0.5 s in these units."""
    seen = _pushed(lambda change, rng: 0.5 * change * rng.standard_normal(change.shape))
    found = random_delay(seen)
    assert found is not None and found.gain > EVIDENCE
    assert found.std_s == pytest.approx(0.5, rel=0.15)


@pytest.mark.parametrize("windows", [3, 4, 5])
def test_few_windows_end_in_an_answer_or_none(windows: int) -> None:
    """Four windows are compared, fewer are not; neither is an error."""
    seen = _pushed(lambda change, rng: np.zeros_like(change))
    (rows,), (answer,) = seen.rows, seen.answers
    few = dataclasses.replace(
        rows, residual=rows.residual[:windows], parameter=rows.parameter[:windows], start=rows.start[:windows]
    )
    answers = dataclasses.replace(
        answer, response=answer.response[:, :windows], change=answer.change[:windows]
    )
    found = random_delay(SeenErrors([few], [answers], [PERIOD_S]))
    assert (found is None) == (windows < FEWEST_WINDOWS)


@pytest.mark.parametrize("slow", [False, True])
def test_random_forces_are_no_delays(slow: bool) -> None:
    """The same impulses at any time, or a force that keeps its value through each window."""

    def force(change: FloatArray, rng: np.random.Generator) -> FloatArray:
        drawn = rng.standard_normal((WINDOWS, 1 if slow else SAMPLES))
        return np.asarray(0.35 * drawn * np.ones_like(change))

    found = random_delay(_pushed(force))
    assert found is not None and found.gain < 1


def _slow(change: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return impulses by delays of 1 s that change over 0.1 s, as friction that falls with speed has them."""
    apart = np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES))) * PERIOD_S
    root = np.linalg.cholesky(np.exp(-apart / 0.1) + 1e-9 * np.eye(SAMPLES))
    return np.asarray(change * (rng.standard_normal(change.shape) @ root.T))


def test_delays_that_change_slowly_are_none() -> None:
    """Friction that falls with speed is late at each reversal, over many commands."""
    found = random_delay(_pushed(lambda change, rng: 0.5 * _slow(change, rng)))
    assert found is not None and found.gain == 0.0 and found.deviance > EVIDENCE


def test_random_delays_are_found_beside_slow_ones() -> None:
    """With both, slow ones alone are as likely as random ones alone: that is no reason against these."""

    def both(change: FloatArray, rng: np.random.Generator) -> FloatArray:
        return 0.25 * _slow(change, rng) + 0.5 * change * rng.standard_normal(change.shape)

    found = random_delay(_pushed(both))
    assert found is not None and found.gain > EVIDENCE


def test_random_delays_are_found_beside_a_random_force() -> None:
    """The delays of the first test, and a random force at any time of half their size."""

    def both(change: FloatArray, rng: np.random.Generator) -> FloatArray:
        return 0.5 * change * rng.standard_normal(change.shape) + 0.18 * rng.standard_normal(change.shape)

    found = random_delay(_pushed(both))
    assert found is not None and found.gain > EVIDENCE
    assert found.std_s == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("name", ["delay", "slow delay"])
def test_a_command_is_late_for_all_actuators(name: Process) -> None:
    """Of two motors that push against each other a late command does nothing; of two alike, twice as much."""
    seen = _pushed(lambda change, rng: np.zeros_like(change))
    (answer,) = seen.answers
    variances = []
    for second in (0.0, 1.0, -1.0):
        both = SignatureResponse(
            np.concatenate([answer.response, second * answer.response]), np.repeat(answer.change, 2, axis=2)
        )
        two = SeenErrors(seen.rows, [both], [PERIOD_S])
        windows = [ErrorWindow.of(two, 0, w, np.ones(2), None) for w in range(WINDOWS)]
        variances.append(Covariance.of(windows, name).intensity)
    one, alike, against = variances
    assert alike == pytest.approx(4 * one) and against < 1e-12 * one
