"""Fitness: distances by hand, and every fitness ranks the truth above what is far from it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.recorded_commands import RecordedCommands
from fakes.simulated_episode import simulated_episode

from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.paper.algorithm1 import DealPaper, PaperSettings
from deal_hw.calib.paper.critic import CriticSettings
from deal_hw.calib.paper.fitness import (
    FITNESSES,
    FitnessSettings,
    RolloutView,
    energy_distance,
    make_fitness,
    squared_mmd,
)
from deal_hw.calibration import Budget
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import align

FREE = ("cart.frictionloss", "servo.damping")
SETTINGS = FitnessSettings(critic=CriticSettings(hidden=(32, 32)))


@pytest.fixture(scope="module")
def problem() -> Problem:
    """1.5 s of a robot of twice the nominal values without noise, two parameters free."""
    space = k9_space().with_free(FREE)
    trajectory = simulated_episode(DESCRIPTION, space, 2 * space.nominal, seconds=1.5, latency_ticks=0)
    episode = align(trajectory, DESCRIPTION)
    return Problem(
        load_model(DESCRIPTION),
        space,
        [episode],
        threads=1,
        fixed_latency_s=0.0,
        policy=RecordedCommands.of(episode.target, 20),
    )


def members(problem: Problem) -> Members:
    """Return the truth, one near it and one far from it."""
    truth = 2 * problem.space.nominal
    theta = np.stack([truth, 1.2 * truth, 0.3 * truth])
    return Members(np.clip(theta, problem.space.low, problem.space.high), np.zeros(3))


def test_energy_distance_by_hand() -> None:
    """0 and 2 against 1: 2 * 1 - (0 + 2 + 2 + 0) / 4 - 0 = 1; the origin against (3, 4): 2 * 5."""
    assert energy_distance(np.array([[0.0], [2.0]]), np.array([[1.0]])) == pytest.approx(1.0)
    assert energy_distance(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0]])) == pytest.approx(10.0)
    same = np.random.default_rng(0).standard_normal((20, 3))
    assert energy_distance(same, same) == pytest.approx(0.0, abs=1e-12)


def test_squared_mmd_by_hand() -> None:
    """0 against 1 at h = 1: 1 + 1 - 2 exp(-1/2); 0 and 2 against 1: (1 + exp(-2)) / 2 + 1 - 2 exp(-1/2)."""
    assert squared_mmd(np.array([[0.0]]), np.array([[1.0]]), 1.0) == pytest.approx(2 - 2 * np.exp(-0.5))
    wanted = (1 + np.exp(-2.0)) / 2 + 1 - 2 * np.exp(-0.5)
    assert squared_mmd(np.array([[0.0], [2.0]]), np.array([[1.0]]), 1.0) == pytest.approx(wanted)
    # Twice as wide a kernel sees what is twice as near.
    near = squared_mmd(np.array([[0.0]]), np.array([[0.5]]), 1.0)
    assert squared_mmd(np.array([[0.0]]), np.array([[1.0]]), 2.0) == pytest.approx(near)


@pytest.mark.parametrize("name", ["trajectory", "energy", "mmd"])
def test_truth_scores_best_and_far_worst(problem: Problem, name: str) -> None:
    """The order of truth, near and far is the order of their scores."""
    score = make_fitness(name, problem, np.random.default_rng(0), SETTINGS).score(members(problem))
    assert score[0] > score[1] > score[2]


def test_trajectory_is_the_logarithm_of_the_mean_square(problem: Problem) -> None:
    """Scores are minus ln of the mean squared whitened innovation, whatever generation asks."""
    from deal_hw.calib.data.innovations import cut, whitened_residual

    fitness = make_fitness("trajectory", problem, np.random.default_rng(0), FitnessSettings(window_ticks=5))
    centre = Members(problem.space.center[None], np.zeros(1))
    residual = whitened_residual(problem, members(problem), centre, cut(problem, 5))
    wanted = -np.log(np.mean(residual**2, axis=1))
    np.testing.assert_allclose(fitness.score(members(problem)), wanted, rtol=1e-9)
    # One number a member, whoever else is scored with it.
    alone = Members(members(problem).theta[1:2], np.zeros(1))
    np.testing.assert_allclose(fitness.score(alone), wanted[1:2], rtol=1e-9)


def test_flat_sees_nothing(problem: Problem) -> None:
    """The no-data baseline: one score for all, no simulation."""
    steps = problem.steps
    fitness = make_fitness("flat", problem, np.random.default_rng(0))
    np.testing.assert_array_equal(fitness.score(members(problem)), np.zeros(3))
    assert problem.steps == steps


@pytest.mark.parametrize("name", FITNESSES)
def test_saved_fitness_goes_on_exactly(problem: Problem, name: str) -> None:
    """After save and load into a new one, later scores are the same to the last bit."""
    from deal_hw.calib.data.resume import pack, unpack

    settings = dataclasses.replace(SETTINGS, replay_generations=3)
    first = make_fitness(name, problem, np.random.default_rng(1), settings)
    for _ in range(2):
        first.score(members(problem))
    state = unpack(pack(first.save()))
    second = make_fitness(name, problem, np.random.default_rng(2), settings)
    second.load(state)
    for _ in range(2):
        np.testing.assert_array_equal(second.score(members(problem)), first.score(members(problem)))
        assert second.values == first.values


def test_replay_that_is_forgotten_is_not_saved(problem: Problem) -> None:
    """With one generation of replay there is nothing of it to save; with three, two."""
    for generations, kept in ((1, 0), (3, 2)):
        settings = dataclasses.replace(SETTINGS, replay_generations=generations)
        fitness = make_fitness("critic", problem, np.random.default_rng(1), settings)
        for _ in range(4):
            fitness.score(members(problem))
        assert len(fitness.save()["_replay"]) == kept


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trajectory", "energy", "mmd"])
def test_deal_paper_takes_another_fitness(problem: Problem, name: str) -> None:
    """Algorithm 1 on another fitness and a log range: median error of three seeds within 0.15 for ln 2."""
    method = DealPaper(PaperSettings(fitness=name, linear=False, difference=True))
    errors = []
    for seed in range(3):
        result = method.run(problem, Budget(population=60, generations=15), np.random.default_rng(seed))
        assert result.provenance["settings"]["fitness"] == name
        errors.append(np.mean(np.abs(np.log(result.estimate / (2 * problem.space.nominal)))))
    assert np.median(errors) < 0.15


@pytest.mark.parametrize(
    ("task", "seconds", "expected"),
    [
        ("go2", 6.0, 250),
        pytest.param("allegro", 13.0, 600, marks=pytest.mark.slow),
        ("allegro", 4.0, 200),
        ("ant", 6.0, 200),
    ],
)
def test_a_rollout_has_the_transitions_of_the_papers_table_4(
    task: str, seconds: float, expected: int
) -> None:
    """250 of the Go2, 600 of the hand, 200 of the others; a shorter recording gives all that it has."""
    d = make_case(task, "ideal", 3, 3.0, by_policy=True, seconds=seconds)
    problem = Problem(d.robot, d.space, [d.fit], threads=1, policy=d.policy)
    view = RolloutView(problem, FitnessSettings(), np.random.default_rng(0))
    assert len(view.real) == pytest.approx(expected, abs=1)
    assert len(RolloutView(problem, FitnessSettings(ticks=30), np.random.default_rng(0)).real) == 30


def test_bad_names_and_settings_are_refused(problem: Problem) -> None:
    """Each error says what is known or allowed."""
    with pytest.raises(UnknownNameError, match="unknown fitness 'crtic'; known: critic, trajectory"):
        make_fitness("crtic", problem, np.random.default_rng(0))
    for name, value in (("window_ticks", 0), ("ticks", 0), ("replay_generations", 0)):
        with pytest.raises(ConfigurationError, match=name):
            FitnessSettings(**{name: value})  # type: ignore[arg-type]
