"""Contract of every calibration method."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.calibration import (
    Budget,
    CalibrationMethod,
    CalibrationResult,
    Progress,
    ProgressCallback,
    StateStore,
)
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.types import FloatArray

_SEED = 5
_LONG = 6
"""Generations that show whether the state grows with each."""
_FEW = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class MethodCase:
    """A method under test and a small problem with a known answer.

    Attributes:
        method: The method.
        make_problem: Makes a new problem; two parameters of a cart-pole are the usual one.
        truth: The parameters' true values, (K,).
        budget: Enough to recover them.
        short_budget: Enough for a generation.
        tolerance: Largest mean |ln(estimate / truth)| that counts as recovered; None for methods that do not
            read the data.
        open_store: Opens a checkpoint file: path, identity of the run. None if there is no such file; then
            states are kept in memory.
        grows: Whether the method's state grows with its generations by design, as a surrogate's data do.
        seeds: Runs from different seeds whose mean error counts. One suffices where every run ends at the
            truth. The last digits of a processor's arithmetic change a chaotic search as another seed does.
    """

    method: CalibrationMethod[Any]
    make_problem: Callable[[], Any]
    truth: FloatArray
    budget: Budget
    short_budget: Budget
    tolerance: float | None
    open_store: Callable[[Path, str], StateStore] | None = None
    grows: bool = False
    seeds: int = 1

    def run(
        self,
        budget: Budget,
        seed: int = _SEED,
        progress: ProgressCallback | None = None,
        checkpoint: StateStore | None = None,
    ) -> CalibrationResult:
        """Calibrate a new problem."""
        rng = np.random.default_rng(seed)
        return self.method.run(self.make_problem(), budget, rng, progress, checkpoint)

    def store(self, path: Path) -> StateStore:
        """Return a place to keep a run's state."""
        return MemoryStore() if self.open_store is None else self.open_store(path, "mine")

    def log_error(self, estimate: FloatArray) -> float:
        """Return the mean |ln(estimate / truth)|."""
        return float(np.mean(np.abs(np.log(estimate / self.truth))))


class MemoryStore:
    """Keeps the last state in memory, and how many bytes of arrays each one held beside the trace."""

    def __init__(self) -> None:
        self.state: Mapping[str, Any] | None = None
        self.sizes: list[int] = []

    def save(self, state: Mapping[str, Any]) -> None:
        """See :meth:`deal_hw.calibration.StateStore.save`."""
        # The method goes on changing its arrays after saving them.
        self.state = copy.deepcopy(state)
        self.sizes.append(_bytes_of(state))

    def load(self) -> Mapping[str, Any] | None:
        """See :meth:`deal_hw.calibration.StateStore.load`."""
        return copy.deepcopy(self.state)


def _bytes_of(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Mapping):
        return sum(_bytes_of(v) for k, v in value.items() if k != "trace")
    if isinstance(value, list | tuple):
        return 1 + sum(_bytes_of(v) for v in value)
    return 0


class _StopRunError(Exception):
    """Raised by a callback to stop a run."""


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """A short run with the seed of ``short``, what it reported, and its checkpoint (None without a file)."""

    result: CalibrationResult
    reports: tuple[Progress, ...]
    checkpoint: bytes | None


@dataclass(frozen=True, slots=True)
class LongRun:
    """A run over several generations, and the bytes of its saved states."""

    result: CalibrationResult
    sizes: tuple[int, ...]


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

    @pytest.fixture(scope="class")
    @classmethod
    def watched(cls, case: MethodCase, tmp_path_factory: pytest.TempPathFactory) -> WatchedRun:
        """Return a second short run, with reports and a checkpoint."""
        reports: list[Progress] = []
        if case.open_store is None:
            return WatchedRun(case.run(case.short_budget, progress=reports.append), tuple(reports), None)
        path = tmp_path_factory.mktemp("watched") / "checkpoint.npz"
        store = case.open_store(path, "mine")
        result = case.run(case.short_budget, progress=reports.append, checkpoint=store)
        return WatchedRun(result, tuple(reports), path.read_bytes())

    @pytest.fixture(scope="class")
    @classmethod
    def long(cls, case: MethodCase) -> LongRun:
        """Return a run with the whole budget; with a few generations where there is nothing to find."""
        few = Budget(population=max(case.short_budget.population, 20), generations=_LONG)
        store = MemoryStore()
        result = case.run(few if case.tolerance is None else case.budget, checkpoint=store)
        return LongRun(result, tuple(store.sizes))

    def test_recovers_a_known_cartpole(self, case: MethodCase, request: pytest.FixtureRequest) -> None:
        """The truth is found within the stated tolerance, from a range whose midpoint is further off."""
        if case.tolerance is None:
            pytest.skip("this method does not read the data")
        first: LongRun = request.getfixturevalue("long")
        results = [first.result, *(case.run(case.budget, seed=_SEED + k) for k in range(1, case.seeds))]
        assert case.log_error(results[0].space.center) > 2 * case.tolerance
        assert np.mean([case.log_error(result.estimate) for result in results]) <= case.tolerance

    def test_same_seed_same_result(self, short: CalibrationResult, watched: WatchedRun) -> None:
        """The generator decides everything, to the last bit; reports and a checkpoint change nothing."""
        again = watched.result
        np.testing.assert_array_equal(again.estimate, short.estimate)
        np.testing.assert_array_equal(again.interval, short.interval)
        assert again.latency_s == short.latency_s
        assert again.trace == short.trace

    def test_stays_in_bounds(self, watched: WatchedRun) -> None:
        """No estimate, interval, member or latency leaves its range, at any generation."""
        result = watched.result
        seen = [report.population for report in watched.reports if report.population is not None]
        low, high = result.space.low, result.space.high
        for values in (*seen, result.estimate[None], result.interval.T):
            assert np.all(values >= low * (1 - 1e-9))
            assert np.all(values <= high * (1 + 1e-9))
        assert np.all(result.interval[:, 0] <= result.estimate * (1 + 1e-9))
        assert np.all(result.interval[:, 1] >= result.estimate * (1 - 1e-9))
        assert result.latency_interval_s[0] <= result.latency_s <= result.latency_interval_s[1]

    def test_progress_is_reported(self, watched: WatchedRun) -> None:
        """Each generation is reported once, in order, and the trace has as many rows."""
        result, calls = watched.result, [(report.done, report.total) for report in watched.reports]
        assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
        assert all(done <= total for done, total in calls)
        assert len(result.trace) == len(calls) >= 1

    def test_a_callback_can_stop_the_run(self, case: MethodCase) -> None:
        """The run raises the callback's exception unchanged."""

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

    def test_resumed_run_gives_the_same_numbers(
        self, case: MethodCase, short: CalibrationResult, tmp_path: Path
    ) -> None:
        """Stopped at each of its generations and resumed, a run gives the same result to the bit."""
        store = case.store(tmp_path / "checkpoint.npz")
        result, stops = None, 0
        while result is None:
            stops += 1
            try:
                result = case.run(case.short_budget, progress=_stop_at(stops), checkpoint=store)
            except _StopRunError:
                assert stops <= len(short.trace), "a resumed run does not end"
        assert stops == len(short.trace) + 1
        np.testing.assert_array_equal(result.estimate, short.estimate)
        np.testing.assert_array_equal(result.interval, short.interval)
        np.testing.assert_array_equal(result.population, short.population)
        np.testing.assert_equal([dict(row) for row in result.trace], [dict(row) for row in short.trace])
        assert result.latency_s == short.latency_s
        assert result.latency_interval_s == short.latency_interval_s
        assert result.alarms == short.alarms

    def test_checkpoint_of_another_run_is_refused(
        self, case: MethodCase, watched: WatchedRun, tmp_path: Path
    ) -> None:
        """A file with another identity is neither continued nor overwritten."""
        if case.open_store is None or watched.checkpoint is None:
            pytest.skip("this method's states are kept in memory")
        path, before = tmp_path / "checkpoint.npz", watched.checkpoint
        path.write_bytes(before)
        with pytest.raises(ConfigurationError, match="cannot be resumed"):
            case.run(case.short_budget, checkpoint=case.open_store(path, "yours"))
        assert path.read_bytes() == before

    def test_damaged_checkpoint_is_refused(
        self, case: MethodCase, watched: WatchedRun, tmp_path: Path
    ) -> None:
        """An incomplete file, or one that is no checkpoint, gives an error that names the file."""
        if case.open_store is None or watched.checkpoint is None:
            pytest.skip("this method's states are kept in memory")
        path, whole = tmp_path / "checkpoint.npz", watched.checkpoint
        for damaged in (whole[: len(whole) // 2], b"", b"not a checkpoint"):
            path.write_bytes(damaged)
            with pytest.raises(DatasetError, match=r"checkpoint\.npz"):
                case.run(case.short_budget, checkpoint=case.open_store(path, "mine"))

    def test_state_does_not_grow(self, case: MethodCase, request: pytest.FixtureRequest) -> None:
        """The saved state grows when a stage begins, not with each generation; the trace may grow."""
        if case.grows:
            pytest.skip("this method keeps what it has seen")
        run: LongRun = request.getfixturevalue("long")
        growths = int(np.sum(np.diff(run.sizes) > 0))
        assert growths <= _FEW


def _stop_at(generation: int) -> ProgressCallback:
    def stop(progress: Progress) -> None:
        if progress.done == generation:
            raise _StopRunError

    return stop
