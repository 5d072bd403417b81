"""Rollouts from drawn start states: which first states are unknown, where the draws lie, what they find."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.innovations import Members
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.start_states import drawn_start, given_std, own_std, uncertain_entries
from deal_hw.calib.paper.fitness import FitnessSettings, RolloutView
from deal_hw.calib.paper.rollouts import control_ticks, drawn_ticks, rollout_population
from deal_hw.calib.pipeline.methods import make_method
from deal_hw.calibration import Budget
from deal_hw.errors import UnknownNameError
from deal_hw.sim.recordings.episode import SampledEpisode, thin
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.starts import chosen_starts

FREE = ("cart.frictionloss", "servo.damping")
TICKS = 25
"""Control periods of a rollout from a drawn state."""


@pytest.fixture(scope="module")
def case() -> Case:
    """A cart-pole that a policy balances, recorded without any error."""
    return make_case("cartpole", "ideal", 3, 5.0, by_policy=True)


@pytest.fixture(scope="module")
def history(case: Case) -> int:
    """The policy's memory, in control periods."""
    assert case.policy is not None
    return case.policy.history


def problem_of(case: Case, episode: SampledEpisode | None = None) -> tuple[Problem, FloatArray]:
    """Return the problem of finding two parameters, and their true values."""
    truth = dict(zip(case.space.names, case.theta, strict=True))
    space = case.space.with_known({name: value for name, value in truth.items() if name not in FREE})
    fit = case.fit if episode is None else episode
    problem = Problem(case.robot, space, [fit], threads=1, fixed_latency_s=0.0, policy=case.policy)
    return problem, np.array([truth[name] for name in space.names])


def with_wrong_start(case: Case, history: int) -> SampledEpisode:
    """The recording with a velocity of the pole that is 0.5 rad/s off, in its first state alone."""
    row = int(control_ticks(problem_of(case)[0], 0, 2, history).sample[0])
    velocity = case.fit.velocity.copy()
    velocity[row, 1] += 0.5
    return dataclasses.replace(case.fit, velocity=velocity)


def rarely_sampled(case: Case, noise_std: float = 1e-3) -> SampledEpisode:
    """Positions alone, with noise [m, rad], 50 times a second: velocities are slopes of these."""
    episode = thin(case.fit, 50.0)
    noise = noise_std * np.random.default_rng(0).standard_normal(episode.position.shape)
    unknown = np.full_like(episode.velocity, np.nan)
    position = episode.position + noise
    return dataclasses.replace(episode, position=position, velocity=unknown, noise_free=False)


def test_drawn_parts_lie_in_the_recording_with_their_own_past(case: Case, history: int) -> None:
    """As many periods as before, in order, each part with the states that the policy saw before it."""
    problem, _ = problem_of(case)
    whole = control_ticks(problem, 0, None, history)
    states = np.concatenate([whole.past, whole.sample])
    parts = drawn_ticks(problem, 0, 200, TICKS, np.random.default_rng(1), history)
    assert len(parts) == round(min(200, len(whole)) / TICKS) and {len(part) for part in parts} == {TICKS}
    begins = [part.number - whole.number for part in parts]
    assert begins == sorted(begins) and len(set(begins)) == len(begins)
    assert 0 <= begins[0] and begins[-1] + TICKS <= len(whole)
    for begin, part in zip(begins, parts, strict=True):
        np.testing.assert_array_equal(part.sample, whole.sample[begin : begin + TICKS + 1])
        np.testing.assert_array_equal(part.past, states[begin : begin + history])
        assert part.lead == whole.lead
    again = drawn_ticks(problem, 0, 200, TICKS, np.random.default_rng(1), history)
    assert [part.number for part in again] == [part.number for part in parts]


def test_changes_of_gains_move_with_a_part(case: Case) -> None:
    """A limit that was changed in tick 49 is changed in tick 19 of the part that begins with tick 30."""
    whole = dataclasses.replace(control_ticks(problem_of(case)[0], 0), changes=(0, 49, 90))
    assert whole.part(30, 40, 14).changes == (0, 19)
    assert whole.part(49, 20, 14).changes == (0,)
    assert len(whole.part(3, 20, 14).past) == 3 + len(whole.past)


def test_the_truth_repeats_the_recording_from_every_drawn_state(case: Case, history: int) -> None:
    """Twenty control periods to 0.1 mm and 0.1 mrad, wherever in the recording the rollout begins."""
    problem, theta = problem_of(case)
    truth = Members(theta[None], np.zeros(1))
    for part in drawn_ticks(problem, 0, 200, 20, np.random.default_rng(2), history):
        position, _, action = rollout_population(problem, truth, 0, part)
        assert np.abs(position[0] - case.fit.position[part.sample]).max() < 1e-4
        assert np.abs(action[0, 0] - case.fit.target[part.action[0]]).max() < 1e-4


def test_members_begin_in_states_of_their_own(case: Case, history: int) -> None:
    """Each lies where the draws put it; the same in all generations, and nothing moves without a spread."""
    problem, theta = problem_of(case)
    members = Members(np.repeat(theta[None], 40, axis=0), np.zeros(40))
    problem = problem.sharing(start_std=given_std(problem, {"pole.velocity": 0.2}))
    views = [RolloutView(problem, FitnessSettings(ticks=50), np.random.default_rng(3)) for _ in range(2)]
    first, usable = views[0].rollouts(members)
    np.testing.assert_array_equal(first, views[0].rollouts(members)[0])
    np.testing.assert_array_equal(first, views[1].rollouts(members)[0])
    assert usable.all() and first.shape[1] == len(views[0].real) == 50
    parts = drawn_ticks(problem, 0, 50, TICKS, np.random.default_rng(3), history)
    part = parts[0]
    moved = np.zeros((40, 4))
    moved[:, 3] = np.linspace(-1, 1, 40)
    position, velocity, _ = rollout_population(problem, members, 0, part, moved=moved)
    np.testing.assert_allclose(velocity[:, 0, 1], case.fit.velocity[part.sample[0], 1] + moved[:, 3])
    np.testing.assert_allclose(position[:, 0], np.tile(case.fit.position[part.sample[0]], (40, 1)))
    plain = RolloutView(problem.sharing(start_std=None), FitnessSettings(ticks=50), np.random.default_rng(3))
    assert np.ptp(plain.rollouts(members)[0], axis=0).max() == 0


def test_drawn_states_have_the_spread_of_the_true_ones(case: Case) -> None:
    """Draws around smoothed velocities would spread more than these do, and these more than the true ones."""
    problem, _ = problem_of(case, rarely_sampled(case, 5e-3))
    inner = slice(10, -10)
    rng = np.random.default_rng(4)
    rows = np.repeat(np.arange(len(problem.starts[0].velocity))[inner], 20)
    unknown = np.full(4, np.nan)
    draws = []
    for row in rows:
        middle, std = drawn_start(problem, 0, int(row), unknown)
        draws.append(problem.starts[0].velocity[row] + middle[2:] + std[2:] * rng.standard_normal(2))
    spread = float(np.std([draw[0] for draw in draws]))
    smoothed = float(problem.starts[0].velocity[inner, 0].std())
    around = float(np.hypot(smoothed, own_std(problem, 0)[inner, 2].mean()))
    assert spread < 1.02 * smoothed < 0.96 * around
    middle, std = drawn_start(problem, 0, 12, np.array([np.nan, np.nan, np.nan, 0.7]))
    assert std[3] == 0.7 and middle[3] == 0.0


def test_a_first_state_that_the_recording_shows_is_kept(case: Case) -> None:
    """Nothing is drawn and nothing said where positions and velocities are exact."""
    problem, _ = problem_of(case)
    printed: list[str] = []
    assert uncertain_entries(problem, [0]) == {}
    assert chosen_starts(problem, None, {}, printed.append) is None and not printed
    assert chosen_starts(problem, "recorded", {}, printed.append) is None
    drawn = chosen_starts(problem, "drawn", {}, printed.append)
    assert drawn is not None and np.isnan(drawn).all() and not printed
    given = chosen_starts(problem, None, {"pole.velocity": 0.5}, printed.append)
    assert given is not None
    np.testing.assert_array_equal(given, [np.nan, np.nan, np.nan, 0.5])


def test_an_unknown_first_state_is_said_and_drawn(case: Case) -> None:
    """Its velocities are uncertain by more than a quarter of their spread; positions are known."""
    problem, _ = problem_of(case, rarely_sampled(case, 5e-3))
    found = uncertain_entries(problem, [0])
    assert found and set(found) <= {"cart.velocity", "pole.velocity"}
    assert min(found.values()) > 0.25 and np.isfinite(own_std(problem, 0)).all()
    printed: list[str] = []
    chosen = chosen_starts(problem, None, {}, printed.append)
    assert chosen is not None and np.isnan(chosen).all()
    assert "velocity (" in printed[0] and "--starts recorded begins" in printed[0]


def test_an_unknown_entry_is_refused(case: Case) -> None:
    """The message lists the entries of the state."""
    with pytest.raises(UnknownNameError, match=r"entry of the start state 'pole.speed'.*pole.velocity"):
        chosen_starts(problem_of(case)[0], None, {"pole.speed": 1.0}, lambda _: None)


@pytest.mark.slow
def test_drawn_states_find_the_truth_although_the_first_state_is_wrong(case: Case, history: int) -> None:
    """Both parameters within 5 %; from the recorded first state neither is within 10 %."""
    problem, theta = problem_of(case, with_wrong_start(case, history))
    method, budget = make_method("moments-unaligned"), Budget(population=20, generations=12)
    errors = {}
    for name, std in (("recorded", None), ("drawn", given_std(problem, {}))):
        found = method.run(problem.sharing(start_std=std), budget, np.random.default_rng(0))
        errors[name] = np.abs(np.log(found.estimate / theta))
    assert np.all(errors["drawn"] < 0.05)
    assert np.all(errors["recorded"] > 0.1)
