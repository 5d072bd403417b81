"""Stopped and resumed searches end bit for bit where they would have: stages, restarts, refinement."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint, run_identity
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calib.pipeline.minima import RestartSettings
from deal_hw.calib.pipeline.stages import CalibrationPipeline, Refinement
from deal_hw.calib.search.deal import Deal, DealSettings
from deal_hw.calib.search.eki import Eki, EkiSettings
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align

FREE = ("cart.frictionloss", "servo.damping")


def make_problem(noise_std: float = 0.0, seconds: float = 1.5) -> Problem:
    """Return a short recording of a robot of 1.5 times the nominal values."""
    space = k9_space().with_free(FREE)
    trajectory = simulated_episode(DESCRIPTION, space, 1.5 * space.nominal, seconds=seconds, latency_ticks=3)
    noise = noise_std * np.random.default_rng(9).standard_normal(trajectory.position.shape)
    trajectory = dataclasses.replace(trajectory, position=trajectory.position + noise)
    return Problem(load_model(DESCRIPTION), space, [align(trajectory, DESCRIPTION)], threads=1)


class StoppedError(Exception):
    """Raised by the callback below."""


def run(
    method: CalibrationMethod[Any],
    problem: Problem,
    budget: Budget,
    store: SearchCheckpoint | None,
    most: int,
) -> CalibrationResult:
    """Run until the callback has been called ``most`` times; 0 for to the end."""
    calls = 0

    def progress(_: Progress) -> None:
        nonlocal calls
        calls += 1
        if calls == most:
            raise StoppedError

    return method.run(problem, budget, np.random.default_rng(4), progress, store)


def check_same(a: CalibrationResult, b: CalibrationResult) -> None:
    """Check that two results agree to the last bit."""
    np.testing.assert_array_equal(a.estimate, b.estimate)
    np.testing.assert_array_equal(a.interval, b.interval)
    np.testing.assert_array_equal(a.population, b.population)
    np.testing.assert_equal([dict(row) for row in a.trace], [dict(row) for row in b.trace])
    assert (a.latency_s, a.latency_interval_s, a.chi2, a.alarms) == (
        b.latency_s,
        b.latency_interval_s,
        b.chi2,
        b.alarms,
    )


STAGED: dict[str, tuple[CalibrationMethod[Any], Budget]] = {
    "eki": (
        Eki(EkiSettings(noisy_ticks=(5, 10), stage_generations=3, restart_chi2=1e-6)),
        Budget(population=10, generations=12),
    ),
    "deal": (
        Deal(DealSettings(noise_draws=20, noisy_ticks=(5, 10))),
        Budget(population=8, generations=6),
    ),
}


@functools.cache
def whole_of(name: str) -> CalibrationResult:
    """Return the result of a run that nobody stopped."""
    method, budget = STAGED[name]
    return run(method, make_problem(1e-3), budget, None, 0)


@pytest.mark.parametrize(
    "stop", [pytest.param(2, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow), 9]
)
def test_eki_over_stages_and_restarts(tmp_path: Path, stop: int) -> None:
    """Whatever it was about: the first stage, a later one with moved start states, or a restart."""
    (method, budget), path = STAGED["eki"], tmp_path / "checkpoint.npz"
    whole = whole_of("eki")
    assert whole.provenance["restarts"] >= 1
    with pytest.raises(StoppedError):
        run(method, make_problem(1e-3), budget, SearchCheckpoint(path, "a"), stop)
    resumed = run(method, make_problem(1e-3), budget, SearchCheckpoint(path, "a"), 0)
    check_same(resumed, whole)
    # The generation in which it was stopped is simulated twice and counted once.
    assert resumed.steps == whole.steps
    assert resumed.provenance["restarts"] == whole.provenance["restarts"]


@pytest.mark.parametrize("stop", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_deal_over_stages_of_a_noisy_recording(tmp_path: Path, stop: int) -> None:
    """Critic, its optimiser and generator, and the moved start states come back."""
    (method, budget), path = STAGED["deal"], tmp_path / "checkpoint.npz"
    whole = whole_of("deal")
    with pytest.raises(StoppedError):
        run(method, make_problem(1e-3), budget, SearchCheckpoint(path, "a"), stop)
    check_same(run(method, make_problem(1e-3), budget, SearchCheckpoint(path, "a"), 0), whole)


@pytest.mark.slow
def test_calibration_keeps_finished_searches(tmp_path: Path) -> None:
    """Stopped in the second search and in the refinement: no search runs twice, the numbers are the same."""
    # Nothing is ever explained and no two searches agree: all three attempts are made.
    fits = Refinement(RestartSettings(explained=0.0, same=0.0, fewest_generations=1, drawn=0))
    search = Eki(EkiSettings(clean_ticks=(5,), stage_generations=3, restart_chi2=1e9))
    method = CalibrationPipeline(search, settings=Validation(local_first=False), fits=fits)
    budget, path = Budget(population=8, generations=9), tmp_path / "checkpoint.npz"
    stages: list[str] = []

    def note(progress: Progress) -> None:
        stages.append(progress.stage)

    whole = method.run(make_problem(), budget, np.random.default_rng(4), note)
    assert whole.provenance["restarts"] == 2
    # Callbacks up to the first refinement's first stage; and, as the search is announced, the first search's
    # result is offered again and the refinement is repeated, up to the second generation of the second one.
    refining = stages.index("refinement") + 1
    searching = stages[refining:].index("search") + 1
    with pytest.raises(StoppedError):
        run(method, make_problem(), budget, SearchCheckpoint(path, "a"), refining)
    saved = SearchCheckpoint(path, "a").load()
    assert saved is not None and len(saved["searches"]) == 1
    with pytest.raises(StoppedError):
        run(method, make_problem(), budget, SearchCheckpoint(path, "a"), searching + 4)
    saved = SearchCheckpoint(path, "a").load()
    assert saved is not None and len(saved["searches"]) == 2
    resumed = run(method, make_problem(), budget, SearchCheckpoint(path, "a"), 0)
    check_same(resumed, whole)
    assert resumed.provenance["restarts"] == 2
    np.testing.assert_array_equal(resumed.covariance, whole.covariance)


def test_finished_checkpoint_gives_the_result_again(tmp_path: Path) -> None:
    """A run that was stopped after its last generation has nothing left to simulate but the verdict."""
    method, budget = make_method("random"), Budget(population=10, generations=2)
    store = SearchCheckpoint(tmp_path / "checkpoint.npz", "a")
    whole = run(method, make_problem(), budget, store, 0)
    problem = make_problem()
    again = run(method, problem, budget, store, 1)
    check_same(again, whole)
    assert problem.steps < whole.steps


def test_identity_changes_with_all_that_decides_the_numbers() -> None:
    """Data, space, latency, method, settings, budget and seed each count; threads do not."""
    problem = make_problem()
    rng = np.random.default_rng

    def identity(
        problem: Problem = problem, method: Any = None, budget: Budget | None = None, seed: int = 0
    ) -> str:
        return run_identity(problem, method or Eki(), budget or Budget(), rng(seed))

    def other(**changes: Any) -> Problem:
        fields: dict[str, Any] = {"threads": 1, "fixed_latency_s": None, "space": problem.space}
        fields |= changes
        return Problem(problem.robot, episodes=problem.episodes, **fields)

    assert identity() == identity(make_problem()) == identity(other(threads=2))
    different = [
        identity(),
        identity(make_problem(1e-3)),
        identity(other(fixed_latency_s=0.003)),
        identity(other(space=problem.space.with_ratio(3.0))),
        identity(method=Deal()),
        identity(method=Eki(EkiSettings(widen=0.6))),
        identity(method=CalibrationPipeline(Eki())),
        identity(method=CalibrationPipeline(Eki(EkiSettings(widen=0.6)))),
        identity(budget=Budget(population=99)),
        identity(seed=1),
        run_identity(
            Problem(load_model(DESCRIPTION, 0.0005), problem.space, problem.episodes, threads=1),
            Eki(),
            Budget(),
            rng(0),
        ),
    ]
    assert len(set(different)) == len(different)
