"""What every calibration method must do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, Progress, ProgressCallback
from deal_hw.types import FloatArray

_SEED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodCase:
    """A method under test and a small problem with a known answer.

    Attributes:
        method: The method.
        make_problem: Makes a new problem; two parameters of a cart-pole are the usual one.
        truth: The parameters' true values, (K,).
        budget: Enough to recover them.
        short_budget: As little as makes a generation.
        tolerance: Largest mean |ln(estimate / truth)| that counts as recovered; None for methods that do not
            read the data.
    """

    method: CalibrationMethod[Any]
    make_problem: Callable[[], Any]
    truth: FloatArray
    budget: Budget
    short_budget: Budget
    tolerance: float | None

    def run(
        self, budget: Budget, seed: int = _SEED, progress: ProgressCallback | None = None
    ) -> CalibrationResult:
        """Calibrate a new problem."""
        return self.method.run(self.make_problem(), budget, np.random.default_rng(seed), progress)

    def log_error(self, estimate: FloatArray) -> float:
        """Return the mean |ln(estimate / truth)|."""
        return float(np.mean(np.abs(np.log(estimate / self.truth))))


class _StopRunError(Exception):
    """Raised by a callback that has seen enough."""


class MethodSuite:
    """Contract of a calibration method; inherit it and override ``case``, with class scope."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        raise NotImplementedError("a MethodSuite overrides the fixture `case`")

    @pytest.fixture(scope="class")
    @classmethod
    def short(cls, case: MethodCase) -> CalibrationResult:
        """Return the result of a short run."""
        return case.run(case.short_budget)

    def test_recovers_a_known_cartpole(self, case: MethodCase) -> None:
        """The truth is found within the stated tolerance, from a range whose centre is further off."""
        if case.tolerance is None:
            pytest.skip("this method does not read the data")
        result = case.run(case.budget)
        assert case.log_error(result.space.center) > 2 * case.tolerance
        assert case.log_error(result.estimate) <= case.tolerance

    def test_same_seed_same_result(self, case: MethodCase, short: CalibrationResult) -> None:
        """The generator decides everything, to the last bit."""
        again = case.run(case.short_budget)
        np.testing.assert_array_equal(again.estimate, short.estimate)
        np.testing.assert_array_equal(again.interval, short.interval)
        assert again.latency_s == short.latency_s
        assert again.trace == short.trace

    def test_stays_in_bounds(self, case: MethodCase) -> None:
        """No estimate, interval, member or latency leaves the range that was asked for, at any generation."""
        seen: list[FloatArray] = []

        def watch(progress: Progress) -> None:
            if progress.population is not None:
                seen.append(progress.population)

        result = case.run(case.short_budget, progress=watch)
        low, high = result.space.low, result.space.high
        for values in (*seen, result.estimate[None], result.interval.T):
            assert np.all(values >= low * (1 - 1e-9))
            assert np.all(values <= high * (1 + 1e-9))
        assert np.all(result.interval[:, 0] <= result.estimate * (1 + 1e-9))
        assert np.all(result.interval[:, 1] >= result.estimate * (1 - 1e-9))
        assert result.latency_interval_s[0] <= result.latency_s <= result.latency_interval_s[1]

    def test_progress_is_reported(self, case: MethodCase) -> None:
        """Each generation is reported once, in order, and the trace has as many rows."""
        calls: list[tuple[int, int]] = []
        result = case.run(case.short_budget, progress=lambda p: calls.append((p.done, p.total)))
        assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
        assert all(done <= total for done, total in calls)
        assert len(result.trace) == len(calls) >= 1

    def test_a_callback_can_stop_the_run(self, case: MethodCase) -> None:
        """What the callback raises comes out of the run unchanged."""

        def stop(_: Progress) -> None:
            raise _StopRunError

        with pytest.raises(_StopRunError):
            case.run(case.budget, progress=stop)

    def test_result_says_what_was_run(self, case: MethodCase, short: CalibrationResult) -> None:
        """The result names its method, its space, its cost and its settings, and survives JSON."""
        problem_space = short.space
        assert short.method == case.method.name
        assert short.estimate.shape == (len(problem_space),)
        assert short.seconds > 0.0
        assert "settings" in short.provenance
        again = CalibrationResult.from_json(short.to_json())
        np.testing.assert_allclose(again.estimate, short.estimate)
