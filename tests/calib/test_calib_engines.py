"""Which engine simulates what of a calibration: populations of searches the chosen one, all else MuJoCo."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np
import pytest

from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import run_identity
from deal_hw.calib.data.search import Search
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.paper.algorithm1 import paper
from deal_hw.calib.paper.rollouts import control_ticks, policy_of, rollout_population
from deal_hw.calib.search.deal import Deal
from deal_hw.calib.search.eki import Eki
from deal_hw.calibration import Budget, CalibrationResult
from deal_hw.sim.engine import batch as simulators
from deal_hw.sim.engine.engines import Engine, MujocoEngine
from deal_hw.sim.engine.gpu import EngineName

BUDGET = Budget(population=8, generations=2)


@pytest.fixture
def brief(noisy_problem: Problem) -> Problem:
    """A second of the noisy demonstration."""
    episode = noisy_problem.episodes[0]
    begun = np.arange(len(episode.sample)) < round(1.0 / episode.period_s)
    return noisy_problem.part([begun])


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Names of engines that were asked for, with their members; all are MuJoCo's."""
    made: list[tuple[str, int]] = []

    def make(
        name: EngineName, model: mujoco.MjModel, nominal: mujoco.MjModel, count: int, threads: int
    ) -> Engine:
        made.append((name, count))
        return MujocoEngine(model, nominal, count, threads)

    monkeypatch.setattr(simulators, "make_engine", make)
    return made


def on(problem: Problem, engine: EngineName) -> Problem:
    """Return the problem with its populations on an engine."""
    return problem.sharing(engine=engine, threads=1)


def searched(problem: Problem, search: Search) -> CalibrationResult:
    """Search two generations."""
    return search.run(problem, BUDGET, np.random.default_rng(0), None, None)


@pytest.mark.parametrize("search", [Eki(), Deal()], ids=lambda search: search.name)
def test_only_populations_are_on_the_chosen_engine(
    noisy: Any, brief: Problem, made: list[tuple[str, int]], search: Search
) -> None:
    """The search makes one simulator there, of its population; linearisation and refinement make none."""
    problem = on(brief, "warp")
    searched(problem, search)
    assert [count for name, count in made if name == "warp"] == [BUDGET.population]
    made.clear()
    refine(problem, noisy.theta, noisy.latency_s, (0.1,))
    assert made and all(name == "mujoco" for name, _ in made)


@pytest.fixture
def in_loop() -> Problem:
    """A cart-pole that a policy moves, which every simulator runs, too."""
    case = make_case("cartpole", "ideal", 1, 5.0, by_policy=True)
    return Problem(case.robot, case.space, [case.fit], threads=1, policy=case.policy)


def test_a_policy_runs_in_the_populations_of_the_chosen_engine(
    in_loop: Problem, made: list[tuple[str, int]]
) -> None:
    """One simulator of all members there, where MuJoCo has one for each thread; with the same numbers."""
    found = [searched(on(in_loop, engine), paper()) for engine in ("mujoco", "warp")]
    np.testing.assert_array_equal(found[1].estimate, found[0].estimate)
    assert {count for name, count in made if name == "warp"} == {BUDGET.population}


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)")
def test_a_policy_does_the_same_on_warp(in_loop: Problem) -> None:
    """Eight ticks in closed loop with latencies of their own; then rounding grows where friction turns."""
    rng = np.random.default_rng(0)
    members = Members(in_loop.space.sample(rng, 4), rng.uniform(0.0, 0.02, 4))
    ticks = control_ticks(in_loop, 0, 8, policy_of(in_loop).history)
    found = [rollout_population(on(in_loop, engine), members, 0, ticks) for engine in ("mujoco", "warp-cpu")]
    for first, second in zip(*found, strict=True):
        assert np.isfinite(first).all()
        np.testing.assert_allclose(second, first, atol=2e-4)


def test_a_search_is_resumed_on_its_own_engine_only(noisy_problem: Problem) -> None:
    """The engine is a part of the run's identity: another one rounds differently."""
    other = on(noisy_problem, "warp")
    rng = np.random.default_rng(0)
    assert run_identity(noisy_problem, Eki(), BUDGET, rng) != run_identity(other, Eki(), BUDGET, rng)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="MuJoCo Warp is not installed (extra gpu)")
@pytest.mark.parametrize("search", [Eki(), Deal()], ids=lambda search: search.name)
def test_a_search_on_warp_ends_beside_that_on_mujoco(brief: Problem, search: Search) -> None:
    """Two generations of eight from one seed: a critic's training enlarges the differences of rounding."""
    found = [searched(on(brief, engine), search) for engine in ("mujoco", "warp-cpu")]
    space = brief.space
    first, second = (space.normalize(result.estimate) for result in found)
    assert not np.array_equal(first, second)
    np.testing.assert_allclose(second, first, atol=1e-3 if search.name == "eki" else 1e-2)
