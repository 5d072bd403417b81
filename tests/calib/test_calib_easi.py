"""`easi`: the refit by hand, the box as published, and the contract."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deal_hw.calib.baselines.easi import Easi, EasiSettings, EliteGaussian, elite_weights, logarithmic
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calib.paper.fitness import FITNESSES
from deal_hw.calibration import Budget
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.recordings.episode import SampledEpisode
from deal_hw.testing.method_suite import MethodCase, MethodSuite
from deal_hw.types import FloatArray

Recorded = tuple[ParameterSpace, FloatArray, SampledEpisode]


class TestEasi(MethodSuite):
    """`easi` with its critic keeps the contract; what it finds is tested below."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=Easi(),
            make_problem=small_problem,
            truth=recorded()[1],
            budget=Budget(population=10, generations=3),
            short_budget=Budget(population=10, generations=3),
            tolerance=None,
            open_store=SearchCheckpoint,
            grows=False,
        )


class TestEasiOfTrajectories(MethodSuite):
    """The same evolution strategy on the trajectory error: within 5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls, recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]) -> MethodCase:
        """Return the method under test."""
        return MethodCase(
            method=Easi(EasiSettings(fitness="trajectory", linear=False)),
            make_problem=small_problem,
            truth=recorded()[1],
            budget=Budget(population=30, generations=12),
            short_budget=Budget(population=10, generations=3),
            tolerance=0.05,
            open_store=SearchCheckpoint,
            grows=False,
        )


def test_weights_by_hand() -> None:
    """Of four members two survive: ln(5/2) - ln 1 = 0.91629 and ln(5/2) - ln 2 = 0.22314, over their sum."""
    np.testing.assert_allclose(elite_weights(4, 2), [0.804163, 0.195837], atol=1e-6)
    assert np.all(elite_weights(101, 50) > 0.0)


def test_refit_by_hand() -> None:
    """Elites at 0.2 and 0.6: mean 0.80416 x 0.2 + 0.19584 x 0.6, variance 0.80416 x 0.19584 x 0.4 squared."""
    search = EliteGaussian(np.array([[0.9], [0.6], [0.2], [0.5]]), 0.5, np.random.default_rng(0))
    search.tell(np.array([-3.0, 1.0, 2.0, -np.inf]))
    np.testing.assert_allclose(search.mean, [0.278335], atol=1e-6)
    np.testing.assert_allclose(search.std**2, [0.0251979], atol=1e-6)


def test_diverged_members_are_never_elites() -> None:
    """One member has a score: the Gaussian is that member; none has: it stays what it was."""
    start = np.array([[0.9], [0.6], [0.2], [0.5]])
    search = EliteGaussian(start, 0.5, np.random.default_rng(0))
    search.tell(np.array([np.nan, -np.inf, 7.0, np.inf]))
    assert (search.mean[0], search.std[0]) == (0.2, 0.0)
    np.testing.assert_array_equal(search.ask(), np.full((4, 1), 0.2))
    flat = EliteGaussian(start, 0.5, np.random.default_rng(0))
    flat.tell(np.full(4, -np.inf))
    assert flat.mean[0] == pytest.approx(0.55)


def test_finds_the_top_of_a_hill() -> None:
    """In eleven coordinates of the condition 1000, as many members as the benchmark has: within 1 %."""
    rng = np.random.default_rng(1)
    top, steep = rng.uniform(0.2, 0.8, 11), 10.0 ** np.linspace(0, 3, 11)
    search = EliteGaussian(rng.random((200, 11)), 0.5, rng)
    for _ in range(50):
        search.tell(-((search.ask() - top) ** 2 @ steep))
    np.testing.assert_allclose(search.mean, top, atol=0.01)


@pytest.mark.slow
def test_with_its_critic_it_gets_nearer_than_the_centre(
    recorded: Callable[..., Recorded], small_problem: Callable[..., Problem]
) -> None:
    """Mean |ln| is 0.92 for the centre and, over seeds and budgets, 0.05 to 0.65 for the critic's search."""
    theta = recorded()[1]
    result = logarithmic().run(
        small_problem(), Budget(population=24, generations=20), np.random.default_rng(1)
    )
    error, null = (np.mean(np.abs(np.log(x / theta))) for x in (result.estimate, result.space.center))
    assert error < 0.75 * null
    assert np.isfinite([row["wasserstein"] for row in result.trace]).all()


def test_published_box_is_linear(small_problem: Callable[..., Problem]) -> None:
    """The middle of a range is its arithmetic mean there, and its geometric mean in our own scale."""
    problem, middle = small_problem(), np.full((1, 2), 0.5)
    space = problem.space
    linear, ours = (
        method.coordinates(problem).members(middle).theta[0] for method in (Easi(), logarithmic())
    )
    np.testing.assert_allclose(linear, 0.5 * (space.low + space.high))
    np.testing.assert_allclose(ours, space.center)


def test_published_box_is_searched(small_problem: Callable[..., Problem]) -> None:
    """The linear box keeps to the range too, and its result is another one."""
    budget, theirs = Budget(population=10, generations=2), Easi(EasiSettings(fitness="trajectory"))
    ours = Easi(EasiSettings(fitness="trajectory", linear=False))
    found = [m.run(small_problem(), budget, np.random.default_rng(0)) for m in (ours, theirs)]
    assert np.all(found[1].estimate <= found[1].space.high)
    assert np.all(found[0].estimate != found[1].estimate)


@pytest.mark.parametrize("fitness", sorted(FITNESSES))
def test_takes_every_fitness(fitness: str, small_problem: Callable[..., Problem]) -> None:
    """Each fitness of the table can be asked for; the trace counts members that diverged."""
    result = Easi(EasiSettings(fitness=fitness)).run(
        small_problem(), Budget(population=6, generations=1), np.random.default_rng(0)
    )
    assert result.trace[0]["diverged"] == 0.0


def test_bad_settings_are_refused() -> None:
    """Survivors of more than a half would have negative weights."""
    with pytest.raises(ConfigurationError, match=r"within \(0, 0\.5\], got 0\.6"):
        EasiSettings(survive_rate=0.6)
    with pytest.raises(ConfigurationError, match="2 members or more"):
        EliteGaussian(np.zeros((1, 3)), 0.5, np.random.default_rng(0))
