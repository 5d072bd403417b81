"""`bo`: proposals, trust region, points that are scored again, and the contract."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.baselines.bayesian import (
    BayesianOptimisation,
    BoSettings,
    GaussianProcessSearch,
    TrustRegion,
    _largest_improvement,
    critic_return,
)
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calibration import Budget, Progress
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.method_suite import MemoryStore, MethodCase, MethodSuite
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]


@pytest.mark.slow
class TestBo(MethodSuite):
    """`bo` on the trajectory error: within 25 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=BayesianOptimisation(),
            make_problem=small_problem,
            truth=recorded()[1],
            budget=Budget(population=16, generations=10),
            short_budget=Budget(population=8, generations=3),
            tolerance=0.25,
            open_store=SearchCheckpoint,
            grows=True,
        )


def hill(unit: FloatArray) -> FloatArray:
    """Return minus the squared distance from a point inside the cube, (N,)."""
    return np.asarray(-np.sum((unit - 0.3) ** 2, axis=1))


def searched(*, stationary: bool, generations: int, count: int = 3) -> GaussianProcessSearch:
    """Return a search of the hill after some generations."""
    search = GaussianProcessSearch(count, 16, BoSettings(batch=4), seed=1, stationary=stationary)
    for _ in range(generations):
        search.tell(hill(search.ask()))
    return search


@pytest.mark.slow
def test_finds_the_top_of_a_hill() -> None:
    """Sixteen points and seven batches of four: within 0.05, where the first points' best is further off."""
    search = searched(stationary=True, generations=8)
    assert len(search.points) == 16 + 7 * 4
    assert np.max(np.abs(search.points[search.order[0]] - 0.3)) < 0.05
    assert search.best == hill(search.points).max()
    assert search.fallbacks == 0


@pytest.mark.parametrize("seed", [0, 2])
def test_many_coordinates_and_good_points_outside_the_trust_region(seed: int) -> None:
    """From 20 coordinates on, BoTorch made starts of such points and then refused them."""
    rng = np.random.default_rng(seed)
    points = rng.random((80, 24))
    value = -np.sum((points - 0.5) ** 2, axis=1) + 0.05 * rng.standard_normal(80)
    batch = _largest_improvement(points, value, 4, 0.2, seed, BoSettings())
    assert batch is not None and batch.shape == (4, 24)
    assert np.all((batch >= 0.0) & (batch <= 1.0))


def test_scores_earlier_points_again_where_the_fitness_changes() -> None:
    """Sixteen points a generation: four new, of the others the better half by rank and the newest."""
    search = searched(stationary=False, generations=1)
    first, top = search.points, search.points[search.order[:6]]
    asked = search.ask()
    assert len(asked) == 16
    kept = {tuple(row) for row in asked[:12]}
    assert kept <= {tuple(row) for row in first}
    assert {tuple(row) for row in top} <= kept
    search.tell(-hill(asked))
    np.testing.assert_array_equal(search.points, asked)
    assert search.best == -hill(asked).min()


def test_saved_and_loaded_it_proposes_the_same() -> None:
    """Points, scores and the trust region are the whole state; the caller's torch generator is left alone."""
    import torch

    search = searched(stationary=True, generations=3)
    again = GaussianProcessSearch(3, 16, BoSettings(batch=4), seed=77, stationary=True)
    again.load(search.save())
    before = torch.random.get_rng_state()
    np.testing.assert_array_equal(again.ask(), search.ask())
    assert torch.equal(torch.random.get_rng_state(), before)


def test_diverged_points_count_as_the_worst() -> None:
    """A part without scores is survived; with none or one score the next points are those of Sobol."""
    search = GaussianProcessSearch(2, 8, BoSettings(batch=4), seed=1, stationary=True)
    search.tell(np.full(8, np.nan))
    search.tell(np.array([np.nan, -np.inf, 1.0, np.inf]))
    assert search.fallbacks == 1
    assert search.points[search.order[0]] in search.points[10:11]
    search.tell(np.array([0.0, 2.0, 3.0, np.nan]))
    search.ask()
    assert search.fallbacks == 2


def test_the_process_sees_a_bounded_number_of_points() -> None:
    """Of forty points ten: the best five, and the five newest of the rest."""
    search = GaussianProcessSearch(1, 40, BoSettings(most_points=10), seed=1, stationary=True)
    search.tell(hill(search.ask()))
    search._fitness = -np.arange(len(search.points), dtype=float)
    np.testing.assert_array_equal(search._kept(10), [0, 1, 2, 3, 4, 15, 16, 17, 18, 19])


def test_what_is_forgotten_would_never_be_seen_again() -> None:
    """Told anything for 30 generations, it keeps what it would have kept of all points that ever were."""
    settings = BoSettings(batch=3, most_points=8, elite=2)
    search = GaussianProcessSearch(2, 8, settings, seed=1, stationary=True)
    rng = np.random.default_rng(5)
    points, fitness = np.empty((0, 2)), np.empty(0)
    for _ in range(30):
        asked = np.asarray(rng.uniform(size=(8 if not len(points) else 3, 2)))
        # Rounded scores, so that some are equal; some are of members that diverged.
        reported = np.where(rng.uniform(size=len(asked)) < 0.2, np.nan, rng.normal(size=len(asked)).round(1))
        search._asked = asked
        search.tell(reported)
        points, fitness = np.concatenate([points, asked]), np.concatenate([fitness, reported])
        ranked = np.where(np.isfinite(fitness), fitness, -np.inf)
        best = np.argsort(-ranked, kind="stable")[:4]
        newest = [i for i in range(len(points)) if i not in best][::-1][:4]
        expected = sorted([*best, *newest])
        np.testing.assert_array_equal(search.points, points[expected])
        assert search.best == ranked.max()
    assert search.scored == len(points) == 8 + 29 * 3


@pytest.mark.slow
def test_a_critic_scores_earlier_members_again_and_resumes(small_problem: Callable[..., Problem]) -> None:
    """The paper's row: every generation has the budget's population; resumed after two, the same end."""
    budget, method = Budget(population=8, generations=3), critic_return()
    whole = method.run(small_problem(), budget, np.random.default_rng(1))
    assert [row["scored"] for row in whole.trace] == [8.0, 8.0, 8.0]
    store = MemoryStore()

    def stop(progress: Progress) -> None:
        if progress.done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.run(small_problem(), budget, np.random.default_rng(1), stop, store)
    resumed = method.run(small_problem(), budget, np.random.default_rng(9), None, store)
    np.testing.assert_array_equal(resumed.estimate, whole.estimate)
    np.testing.assert_equal(resumed.trace, whole.trace)


def test_trust_region_grows_and_shrinks() -> None:
    """Doubled after three successes in a row, halved after so many failures, begun again below 2^-7."""
    region = TrustRegion(failures=2)
    for better in (True, True, True):
        region.tell(better=better)
    assert region.length == 1.6
    for better in (False, True, False):
        region.tell(better=better)
    assert region.length == 1.6
    region.tell(better=False)
    assert region.length == 0.8
    lengths = []
    for _ in range(16):
        region.tell(better=False)
        lengths.append(region.length)
    assert min(lengths) == 0.8 * 0.5**6
    assert lengths[-3:] == [0.8, 0.8, 0.4]


def test_bad_settings_are_refused() -> None:
    """Each with what was given."""
    for wrong in ({"batch": 0}, {"elite": 1}, {"most_points": 3}):
        with pytest.raises(ConfigurationError, match="got"):
            BoSettings(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="2 or more, got 1"):
        GaussianProcessSearch(2, 1, BoSettings(), seed=0, stationary=True)
    with pytest.raises(ValueError, match="fitness has shape"):
        GaussianProcessSearch(2, 8, BoSettings(), seed=0, stationary=True).tell(np.zeros(5))
