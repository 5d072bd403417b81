"""`cma`: restarts, bounds, exact resume by replay, and the contract."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.baselines.cma_es import Cma, CmaSettings, RestartedCma
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]


class TestCma(MethodSuite):
    """`cma` on the trajectory error: within 1 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=Cma(),
            make_problem=small_problem,
            truth=recorded()[1],
            budget=Budget(population=20, generations=20),
            short_budget=Budget(population=10, generations=3),
            tolerance=0.01,
            open_store=SearchCheckpoint,
            grows=True,
        )


def hill(unit: FloatArray) -> FloatArray:
    """Return the squared distance from a point inside the cube, (N,)."""
    return np.asarray(np.sum((unit - 0.3) ** 2, axis=1))


def test_finds_the_bottom_and_begins_again() -> None:
    """A run that has converged is followed by one of twice the members; no point leaves the cube."""
    search = RestartedCma(3, 8, CmaSettings(), seed=1)
    for _ in range(400):
        unit = search.ask()
        assert np.all((unit >= 0.0) & (unit <= 1.0))
        before = search.mean
        if search.tell(hill(unit)):
            break
    np.testing.assert_allclose(before, 0.3, atol=1e-5)
    assert (search.restarts, search.population, len(search.ask())) == (1, 16, 16)


def test_optimum_at_the_bound() -> None:
    """The corner of the cube is found although no point may lie beyond it."""
    search = RestartedCma(2, 8, CmaSettings(), seed=1)
    for _ in range(40):
        search.tell(search.ask().sum(axis=1))
    np.testing.assert_allclose(search.mean, 0.0, atol=0.01)


def test_resumes_to_the_last_bit_through_a_restart() -> None:
    """Saved after any generation and loaded by a new search: the same populations, also in the second run."""
    settings = CmaSettings(least_step=0.05)
    search = RestartedCma(2, 6, settings, seed=3)
    asked, states = [], []
    for _ in range(30):
        states.append(search.save())
        asked.append(search.ask())
        search.tell(hill(asked[-1]))
    assert search.restarts >= 1
    for generation in (0, 1, 15, 29):
        again = RestartedCma(2, 6, settings, seed=99)
        again.load(states[generation])
        for later in asked[generation:]:
            np.testing.assert_array_equal(again.ask(), later)
            again.tell(hill(later))


def test_another_generator_state_is_not_touched() -> None:
    """Pycma seeds and draws from NumPy's global generator by default."""
    np.random.seed(5)
    before = np.random.get_state(legacy=False)
    search = RestartedCma(2, 6, CmaSettings(), seed=3)
    search.tell(hill(search.ask()))
    np.testing.assert_equal(np.random.get_state(legacy=False), before)


def test_a_replay_that_leads_elsewhere_is_refused() -> None:
    """The saved mean is checked: another pycma would continue another run under the old one's name."""
    search = RestartedCma(2, 6, CmaSettings(), seed=3)
    search.tell(hill(search.ask()))
    state = {**search.save(), "mean": search.mean + 1e-3}
    with pytest.raises(DatasetError, match="cannot be repeated here"):
        search.load(state)


def test_diverged_members_count_as_the_worst() -> None:
    """The optimum is found although a third of the cube has no cost; a generation without any is survived."""
    search = RestartedCma(2, 10, CmaSettings(), seed=0)
    search.tell(np.full(10, np.nan))
    for _ in range(60):
        unit = search.ask()
        search.tell(np.where(unit[:, 0] > 0.66, np.inf, hill(unit)))
        if search.restarts:
            break
    np.testing.assert_allclose(search.mean, 0.3, atol=0.35 if search.restarts else 1e-3)


def test_keeps_to_the_budget(small_problem: Callable[..., Problem]) -> None:
    """All runs together have at most population times generations members, a row a generation."""
    settings = CmaSettings(population=4, least_step=0.2)
    budget = Budget(population=12, generations=10)
    result = Cma(settings).run(small_problem(), budget, np.random.default_rng(0))
    scored = sum(row["scored"] for row in result.trace)
    assert 100 <= scored <= 120
    assert len(result.trace) <= 10
    assert result.trace[-1]["restarts"] >= 1
    assert result.provenance["restarts"] >= 1


def test_of_a_critic_the_best_of_the_last_generation_counts(small_problem: Callable[..., Problem]) -> None:
    """A critic's numbers of different generations do not compare: the estimate is of the last population."""
    method = Cma(CmaSettings(fitness="critic", population=6))
    result = method.run(small_problem(), Budget(population=6, generations=3), np.random.default_rng(0))
    assert result.population is not None
    assert np.any(np.all(result.population == result.estimate, axis=1))
    assert result.trace[-1]["found"] == result.trace[-1]["best"]


def test_bad_settings_are_refused() -> None:
    """Each with what was given."""
    for wrong in ({"population": 1}, {"least_step": 0.0}):
        with pytest.raises(ConfigurationError, match="got"):
            CmaSettings(**wrong)
    with pytest.raises(ConfigurationError, match="2 or more, got 1"):
        RestartedCma(2, 1, CmaSettings(), seed=0)
    with pytest.raises(ValueError, match="cost has shape"):
        RestartedCma(2, 6, CmaSettings(), seed=0).tell(np.zeros(5))
