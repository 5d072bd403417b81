"""The paper's view: rollouts from the recording's start, with its targets or with a policy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fakes.recorded_commands import RecordedCommands

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.innovations import Members, explained, linearise, predict
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.search import Coordinates
from deal_hw.calib.paper.rollouts import (
    TransitionScale,
    control_ticks,
    demonstration,
    rollout_population,
    transitions,
)
from deal_hw.calib.search.eki import logistic, logit
from deal_hw.errors import InsufficientDataError
from deal_hw.types import FloatArray


@pytest.fixture(scope="module")
def problem(ideal: Case) -> Problem:
    """The problem of that demonstration."""
    return Problem(ideal.robot, ideal.space, [ideal.fit], threads=1)


def members(ideal: Case, latency_s: FloatArray) -> Members:
    """Return the truth and one wrong simulator."""
    return Members(np.stack([ideal.theta, ideal.space.center]), latency_s)


def test_replay_of_the_truth_follows_the_recording(ideal: Case, problem: Problem) -> None:
    """With the true parameters the first second of the unstable pole is reproduced to 0.1 mm and 0.1 mrad."""
    ticks = control_ticks(problem, 0)
    position, velocity, action = rollout_population(
        problem, members(ideal, np.zeros(2)), 0, ticks, replay=True
    )
    recorded = problem.starts[0].position[ticks.sample]
    assert position.shape == (2, len(ticks) + 1, 2)
    assert velocity.shape == position.shape
    np.testing.assert_array_equal(action[0], ideal.fit.target[ticks.start[:-1] + ticks.lead + 10])
    assert np.abs(position[0, :50] - recorded[:50]).max() < 1e-4
    assert np.abs(position[1, :50] - recorded[:50]).max() > 1e-2


def test_policy_in_the_loop_equals_the_replay(ideal: Case, problem: Problem) -> None:
    """A policy that answers with the recorded targets makes the rollouts of the replay, at any latency."""
    target = np.random.default_rng(0).uniform(-0.1, 0.1, (60, 1))
    steps = ideal.fit.target.copy()
    ticks = control_ticks(problem, 0, 60)
    # Until the first tick the set-point rested; a latency looks back to before it.
    steps[: ticks.start[0] + ticks.lead] = ideal.fit.start_setpoint
    steps[ticks.start[0] + ticks.lead : ticks.start[-1] + ticks.lead] = np.repeat(target, 20, axis=0)
    held = dataclasses.replace(ideal.fit, target=steps)
    policy = RecordedCommands(np.concatenate([np.zeros((ticks.number, 1)), target]))
    problem = Problem(ideal.robot, ideal.space, [held], threads=1, policy=policy)
    population = members(ideal, np.array([0.0, 0.0125]))
    replayed = rollout_population(problem, population, 0, ticks, replay=True)
    closed = rollout_population(problem, population, 0, ticks)
    np.testing.assert_allclose(closed[0], replayed[0], atol=1e-9)
    np.testing.assert_allclose(closed[2], replayed[2])


def test_the_truth_in_closed_loop_repeats_the_emulated_robot() -> None:
    """Through driver, bytes and recorder: 20 ticks of the true robot to 10 um and 10 urad, from its past on.

    Later ticks are not compared: this policy chatters, and a difference of 1e-7 grows by half a decade a
    tenth of a second.
    """
    case = make_case("cartpole", "ideal", 1, 5.0, by_policy=True)
    problem = Problem(case.robot, case.space, [case.fit], threads=1, fixed_latency_s=0.0, policy=case.policy)
    assert case.policy is not None and case.policy.history == 14
    ticks = control_ticks(problem, 0, 20, case.policy.history)
    # The state before a command is one device period older; the first command's is not in the recording.
    assert (ticks.lead, ticks.number, len(ticks.past)) == (1, 15, 14)
    position, _, action = rollout_population(problem, members(case, np.zeros(2)), 0, ticks)
    recorded = case.fit.position[ticks.sample]
    assert np.abs(position[0] - recorded).max() < 1e-5
    assert np.abs(action[0] - case.fit.target[ticks.action]).max() < 1e-4
    assert np.abs(position[1] - recorded).max() > 1e-3


def test_gains_change_where_the_recording_changed_them(ideal: Case, problem: Problem) -> None:
    """A change of the effort limit in the middle is sent at its tick and not before."""
    effort = ideal.fit.effort_limit.copy()
    effort[1000:] *= 1e-3
    weak = dataclasses.replace(ideal.fit, effort_limit=effort)
    other = Problem(ideal.robot, ideal.space, [weak], threads=1)
    ticks = control_ticks(other, 0, 80)
    # Commands number 1 and later: that of period 1000 is number 50, the 49th tick's.
    assert ticks.changes[:2] == (0, 49)
    one, two = (
        rollout_population(p, members(ideal, np.zeros(2)), 0, control_ticks(p, 0, 80), replay=True)[0]
        for p in (problem, other)
    )
    np.testing.assert_array_equal(one[:, :50], two[:, :50])
    assert np.abs(one[:, 80] - two[:, 80]).max() > 1e-3


def test_ticks_stop_at_a_gap(ideal: Case) -> None:
    """A lost frame ends the rollout, and a recording without two whole ticks is refused."""
    usable = ideal.fit.usable.copy()
    usable[41] = False
    broken = Problem(ideal.robot, ideal.space, [dataclasses.replace(ideal.fit, usable=usable)], threads=1)
    assert len(control_ticks(broken, 0)) == 9
    usable[3:] = False
    useless = Problem(ideal.robot, ideal.space, [dataclasses.replace(ideal.fit, usable=usable)], threads=1)
    with pytest.raises(InsufficientDataError, match="control periods"):
        control_ticks(useless, 0)


def test_transitions_hold_state_action_and_next_state(problem: Problem) -> None:
    """(s, a, s') or (s, a, s' - s), standardised to mean 0 and variance 1 over the recording."""
    position = np.array([[[1.0, 2.0], [1.5, 1.0], [1.5, 3.0]]])
    velocity = 10 * position
    action = np.array([[[7.0], [8.0]]])
    plain = transitions(position, velocity, action)
    np.testing.assert_allclose(plain[0, 1], [1.5, 1, 15, 10, 8, 1.5, 3, 15, 30])
    made = transitions(position, velocity, action, difference=True)
    np.testing.assert_allclose(made[0, 0], [1, 2, 10, 20, 7, 0.5, -1, 5, -10])
    np.testing.assert_allclose(made[0, 1], [1.5, 1, 15, 10, 8, 0, 2, 0, 20])
    raw = demonstration(problem, 0, control_ticks(problem, 0))
    scale = TransitionScale.of(raw.astype(np.float64))
    scaled = scale.apply(raw.copy())
    kept = np.abs(scaled).max(axis=0) < 5
    np.testing.assert_allclose(scaled[:, kept].mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(scaled[:, kept].std(axis=0), 1, atol=1e-3)


def test_negative_latency_is_a_shift_the_other_way(ideal: Case, problem: Problem) -> None:
    """Predictions go smoothly through latency zero: -1, 0 and 1 ms are nearly on a line."""
    data = problem.windows(40)[0]
    theta = np.repeat(ideal.theta[None], 3, axis=0)
    position = predict(problem, Members(theta, np.array([-1e-3, 0.0, 1e-3])), data)
    plain = problem.predict(theta[:1], np.zeros(1), data).observed
    np.testing.assert_allclose(position[1], plain[0], atol=1e-12)
    slope = np.abs(position[2] - position[0])
    moved = slope > 1e-6
    assert moved.mean() > 0.1
    bend = np.abs(position[0] + position[2] - 2 * position[1])
    assert np.median(bend[moved] / slope[moved]) < 0.2


def test_truth_is_explained_and_a_wrong_simulator_is_not(ideal: Case, problem: Problem) -> None:
    """Whitened innovations have at most their expected size at the truth, a huge one at the centre."""
    truth = Members(ideal.theta[None], np.zeros(1))
    wrong = Members(ideal.space.center[None], np.zeros(1))
    assert explained(problem, truth, 10) < 2.0
    assert explained(problem, wrong, 10) > 1e3


def test_lost_samples_do_not_lower_the_residual(noisy: Case, noisy_problem: Problem) -> None:
    """The truth leaves as much residual of a recording without every fourth sample: those have none."""
    kept = np.arange(len(noisy.fit.sample)) % 4 != 1
    names = ("sample", "position", "velocity", "usable")
    lost = dataclasses.replace(noisy.fit, **{name: getattr(noisy.fit, name)[kept] for name in names})
    truth = Members(noisy.theta[None], np.array([noisy.latency_s]))
    whole, part = (
        explained(noisy_problem.on([e], noisy_problem.noise_std), truth, 20) for e in (noisy.fit, lost)
    )
    assert part == pytest.approx(whole, rel=0.15)


def test_start_states_are_less_certain_at_both_ends_of_a_recording() -> None:
    """A cubic fitted to 21 samples: at the middle 8 times, at the end 1.24 times as certain as one sample.

    The gain of a fitted value is the root of its leverage, h_tt of the polynomial's hat matrix.
    """
    case = make_case("cartpole", "sensor", 1, 5.0)
    problem = Problem(case.robot, case.space, [case.fit], threads=1)
    states, length = problem.starts[0], 2 * round(0.1 / case.fit.period_s / 2) + 1
    powers = np.vander(np.linspace(-1.0, 1.0, length), 4)
    leverage = np.diag(powers @ np.linalg.solve(powers.T @ powers, powers.T))
    half, std = length // 2, 2 * problem.noise_std[:2]
    np.testing.assert_allclose(
        states.std[half:-half, :2], np.tile(std * leverage[half] ** 0.5, (len(states.std) - 2 * half, 1))
    )
    np.testing.assert_allclose(states.std[: half + 1, :2], np.outer(leverage[: half + 1] ** 0.5, std))
    np.testing.assert_allclose(states.std[::-1], states.std)
    assert np.all(states.std[0] > 1.8 * states.typical_std)


def test_whitening_takes_out_a_wrong_start_state(ideal: Case, problem: Problem) -> None:
    """What one standard deviation of start velocity does to a window is whitened to about one."""
    data = problem.windows(20)[0]
    truth = Members(ideal.theta[None], np.zeros(1))
    whitening = linearise(problem, truth, data)
    velocity = data.start_velocity + np.array([0.0, problem.starts[0].typical_std[3]])
    moved = predict(problem, truth, data, data.start_position, velocity)
    size = np.linalg.norm(whitening.apply(moved - whitening.reference)[0], axis=1)
    raw = np.linalg.norm(((moved[0] - whitening.reference) / data.std).reshape(len(size), -1), axis=1)
    assert np.median(size) < 1.1
    assert np.median(raw) > 5 * np.median(size)


def test_coordinates_map_the_cube_to_ranges_and_back(problem: Problem) -> None:
    """Corners of the unit cube are those of the ranges; the latency reaches past its own by the margin."""
    coordinates = Coordinates(problem)
    assert coordinates.count == len(problem.space) + 1
    corners = coordinates.members(np.stack([np.zeros(10), np.ones(10)]))
    np.testing.assert_allclose(corners.theta, [problem.space.low, problem.space.high])
    np.testing.assert_allclose(corners.latency_s, [-0.004, 0.044])
    drawn = coordinates.members(coordinates.sample(np.random.default_rng(0), 500))
    assert drawn.latency_s.min() >= 0.0
    assert drawn.latency_s.max() <= 0.04
    assert coordinates.clip_latency(-0.002) == 0.0
    unit = np.array([[0.2, 0.9]])
    np.testing.assert_allclose(logistic(logit(unit)), unit)


def test_given_latency_is_not_searched(ideal: Case) -> None:
    """A latency that is known stays what it is."""
    given = Problem(ideal.robot, ideal.space, [ideal.fit], threads=1, fixed_latency_s=0.013)
    coordinates = Coordinates(given)
    assert coordinates.count == len(ideal.space)
    np.testing.assert_array_equal(coordinates.members(np.full((3, 9), 0.5)).latency_s, 0.013)
    assert coordinates.clip_latency(0.5) == 0.013
