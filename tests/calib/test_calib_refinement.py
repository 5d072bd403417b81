"""The refinement and the verdicts on its result, on recordings of the real device core with hidden truths."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
import pytest
import scipy
from fakes.fixed_search import FixedSearch
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.bench.scores import error_percent, interval_score, log_error_x100
from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.checks import check_excitation
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit import refinement
from deal_hw.calib.fit.intervals import (
    CORRELATION_SAMPLES,
    FALSE_ALARMS,
    NEAR_STRETCH,
    WHITE_SAMPLES,
    correlation_time,
    intervals,
    uncertainty,
)
from deal_hw.calib.fit.null_space import NullSpace, null_directions, null_space
from deal_hw.calib.fit.refinement import Refined, local_fit, refine
from deal_hw.calib.fit.residual import Normal, Shooting
from deal_hw.calib.fit.solver import correlated_samples
from deal_hw.calib.pipeline import minima, stages
from deal_hw.calib.pipeline.calibration_run import AFTER_FIT, CalibrationRun
from deal_hw.calib.pipeline.conclusion import conclude_fit
from deal_hw.calib.pipeline.methods import make_method, usual_budget
from deal_hw.calib.pipeline.minima import RestartSettings, conclusive, lower_minimum
from deal_hw.calib.pipeline.stages import CalibrationPipeline, Refinement
from deal_hw.calib.validation.checks import doubtful, unexplained
from deal_hw.calib.validation.metrics import HeldOut
from deal_hw.calib.validation.settings import Validation
from deal_hw.calib.validation.time_steps import LatencyScan
from deal_hw.calibration import BEFORE_SEARCH, Budget, Progress
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space, parameter_space
from deal_hw.errors import InsufficientDataError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.types import FloatArray

UNCHECKED = Validation(cross_validation=False, split_half=False, physics_step=False, diagnosis=False)


def test_a_pattern_as_small_as_noise_asks_for_a_search(small_problem: Callable[..., Problem]) -> None:
    """Residuals of the noise's size end the calibration only where they are white as noise is."""
    problem = small_problem()
    found = refine(problem, problem.space.nominal, 0.0)
    white = np.random.default_rng(0).normal(size=(8, 400, 2))
    # The same power with a memory, x[t] = 0.2 x[t - 1] + sqrt(1 - 0.2 ** 2) w[t]: autocorrelation time 1.5.
    pattern = scipy.signal.lfilter([np.sqrt(1 - 0.2**2)], [1, -0.2], white, axis=1)

    def leaving(residual: FloatArray) -> Refined:
        normal = dataclasses.replace(found.normal, residual=(residual,))
        return dataclasses.replace(found, normal=normal, chi2=float(np.mean(residual**2)))

    assert correlation_time((pattern,)) == pytest.approx(1.5, rel=0.1)
    assert conclusive(problem, leaving(white), WHITE_SAMPLES)
    assert conclusive(problem, leaving(pattern))
    assert not conclusive(problem, leaving(pattern), WHITE_SAMPLES)
    # What is far below the noise needs no explanation.
    assert conclusive(problem, leaving(0.5 * pattern), WHITE_SAMPLES)
    # One window: a memory of 0.5 has time 3, with a standard error of about 1. Eight windows are no chance.
    longer = scipy.signal.lfilter([np.sqrt(1 - 0.5**2)], [1, -0.5], white[:1], axis=1)
    assert not conclusive(problem, leaving(longer)) and conclusive(problem, leaving(longer), chance=0.05)
    all_windows = scipy.signal.lfilter([np.sqrt(1 - 0.5**2)], [1, -0.5], white, axis=1)
    assert not conclusive(problem, leaving(all_windows), chance=0.05)


def test_a_local_fit_is_reported_step_by_step(small_problem: Callable[..., Problem]) -> None:
    """Costs are halved within a window length, nothing nominal is reported, and the last is the result."""
    problem = small_problem()
    noted: list[Refined] = []
    found = local_fit(problem, noted.append)
    assert found is not None and np.array_equal(noted[-1].theta, found.theta)
    lengths = [fit.shooting.length for fit in noted]
    assert lengths == sorted(lengths) and lengths.count(lengths[0]) > 3
    for length in set(lengths):
        *steps, _ = [fit.chi2 for fit in noted if fit.shooting.length == length]
        assert all(later < 0.5 * before for before, later in itertools.pairwise(steps))
    assert not any(np.array_equal(fit.theta, problem.space.nominal) for fit in noted)


def test_a_hopeless_fit_does_not_begin_again(small_problem: Callable[..., Problem]) -> None:
    """A limit below the chi2 of the first window length, 2e-10: one run of the solver, no longer windows."""
    problem = small_problem()
    whole = refine(problem, problem.space.nominal, 0.0)
    early = refine(problem, problem.space.nominal, 0.0, hopeless=1e-12)
    assert early.iterations < whole.iterations and early.shooting.length < whole.shooting.length


@pytest.mark.slow
@pytest.mark.parametrize("rescued_by", ["local fit", "drawn points"])
def test_a_search_that_ends_in_another_minimum_is_not_the_answer(noisy: Case, rescued_by: str) -> None:
    """A search returns the middle of the range. Refined, that is up to 190 % off: chi2 1.68 instead of 0.92.

    The local fit is better, and so is the refinement from a point drawn in the range.
    """
    problem = Problem(noisy.robot, noisy.space, [noisy.fit], threads=1)
    best = refine(problem, noisy.theta, noisy.latency_s)
    search = FixedSearch(problem.space.center, 1e-3, 0.05)
    run = CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=1),
        rng=np.random.default_rng(0),
        attempts=Restarts(search, np.random.default_rng(0), None),
        settings=UNCHECKED,
        local=best if rescued_by == "local fit" else None,
    )
    method = Refinement(RestartSettings(drawn=0 if rescued_by == "local fit" else 8))
    found = method.best(run)
    assert found.theta == pytest.approx(best.theta, rel=0.01)
    assert found.facts["restarts"] == 0


@pytest.mark.slow
def test_members_of_the_search_lead_where_its_mean_does_not() -> None:
    """A second of balancing, without noise: the refined mean of the search leaves 2.5 times the noise.

    No refinement from a point drawn in the ranges leads to the truth, but the third from the population does.
    """
    case = make_case("cartpole", "ideal", 1, 5.0, by_policy=True, seconds=1.0)
    problem = Problem(case.robot, case.space, [case.fit], threads=1)
    budget = usual_budget("default", None, 50, refine=True)
    found = CalibrationPipeline(make_method("eki")).run(problem, budget, np.random.default_rng(case.seed))
    assert found.chi2 < 0.1 and not found.alarms
    assert log_error_x100(found.estimate, case.theta) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("windows_s", [(0.2,), (0.2, 0.4)])
@pytest.mark.parametrize(("lower", "fits"), [(True, 2), (False, 5)])
def test_new_start_states_are_tried_before_drawn_points(
    noisy: Case, monkeypatch: pytest.MonkeyPatch, lower: bool, fits: int, windows_s: tuple[float, ...]
) -> None:
    """A fit that stopped beside the minimum goes on from smoothed start states; then no point is drawn.

    Also where only the shortest windows are explained from there.
    """
    problem = Problem(noisy.robot, noisy.space, [noisy.fit], threads=1)
    best = refine(problem, noisy.theta, noisy.latency_s, (0.2,))
    stuck = dataclasses.replace(refine(problem, noisy.theta, noisy.latency_s, windows_s), chi2=9.0)
    search = FixedSearch(noisy.theta, noisy.latency_s, 0.05)
    run = CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=1),
        rng=np.random.default_rng(0),
        attempts=Restarts(search, np.random.default_rng(0), None),
        settings=Validation(cross_validation=False),
    )
    calls = []

    def refined(_: CalibrationRun, theta: FloatArray, *__: object) -> Refined:
        calls.append(theta)
        return best if lower else stuck

    monkeypatch.setattr(minima, "refined_from", refined)
    monkeypatch.setattr(minima, "from_start", lambda problem, start, **_: refined(run, *start))
    assert (lower_minimum(run, stuck, RestartSettings(drawn=4)) is best) == lower
    assert len(calls) == fits


@pytest.mark.slow
@pytest.mark.parametrize(("drawn", "brief"), [(0, [True, False]), (2, [True])])
def test_only_the_first_search_is_brief(
    noisy: Case, monkeypatch: pytest.MonkeyPatch, drawn: int, brief: list[bool]
) -> None:
    """What a brief search leaves unexplained is searched for to the end, unless drawn points end no lower."""
    problem = Problem(noisy.robot, noisy.space, [noisy.fit], threads=1)
    refined = dataclasses.replace(refine(problem, noisy.theta, noisy.latency_s), chi2=9.0)
    for module in (minima, stages):
        monkeypatch.setattr(module, "refined_from", lambda *_: refined)
    search = FixedSearch(noisy.theta, noisy.latency_s, 0.05)
    run = CalibrationRun(
        problem=problem,
        budget=Budget(population=8, generations=60),
        rng=np.random.default_rng(0),
        attempts=Restarts(search, np.random.default_rng(0), None),
        settings=Validation(cross_validation=False),
    )
    outcome = Refinement(RestartSettings(drawn=drawn)).best(run)
    assert [budget.brief for budget in search.budgets] == brief
    assert outcome.facts["restarts"] == len(brief) - 1


@pytest.mark.slow
def test_refinement_recovers_an_ideal_robot_exactly(ideal: Case) -> None:
    """Truth recovery: from 10 % off, all parameters within 0.01 % and the latency within a microsecond."""
    problem = Problem(ideal.robot, ideal.space, [ideal.fit], threads=1)
    start = ideal.theta * np.exp(0.1 * np.cos(np.arange(9)))
    found = refine(problem, start, 1e-3)
    assert error_percent(found.theta, ideal.theta) < 0.01
    assert abs(found.latency_s - ideal.latency_s) < 1e-6
    assert found.chi2 < 2.0


@pytest.mark.slow
def test_refinement_with_noise_finds_the_latency_and_covers(noisy: Case) -> None:
    """Truth recovery with noise: mean error within 3 %, latency to the tick, 7 of 9 intervals hold."""
    problem = Problem(noisy.robot, noisy.space, [noisy.fit], threads=1)
    stages: list[str] = []

    def watch(p: Progress) -> None:
        stages.append(p.stage)

    method = CalibrationPipeline(
        FixedSearch(noisy.theta, noisy.latency_s + 1e-3, 0.05), settings=Validation(local_first=False)
    )
    result = method.run(problem, Budget(), np.random.default_rng(0), watch)
    assert error_percent(result.estimate, noisy.theta) < 3.0
    assert abs(result.latency_s - noisy.latency_s) < 1.1e-3
    inside = (result.interval[:, 0] <= noisy.theta) & (noisy.theta <= result.interval[:, 1])
    assert inside.sum() >= 7
    assert result.alarms == ()
    assert set(stages) == {BEFORE_SEARCH, "search", "refinement", AFTER_FIT, "latency"}
    assert result.provenance["latency_scan"]["ticks"]


def test_heldout_error_falls_far_below_nominal(noisy: Case) -> None:
    """On another motion family the true parameters predict four times better than the nominal ones."""
    held_out = HeldOut(noisy.robot, noisy.space, [noisy.heldout], threads=1, truth=[noisy.heldout_truth])
    truth = (noisy.theta, noisy.latency_s)
    errors = held_out.errors({"nominal": (noisy.space.nominal, 0.0), "truth": truth}).nrmse
    assert errors["truth"] < 0.25 * errors["nominal"]
    assert errors["truth"] < errors["null"]


def test_no_prediction_of_noisy_samples_errs_by_less_than_their_noise(noisy: Case) -> None:
    """True parameters err by it and by what it does to start states, nominal ones by more; with units."""
    held_out = HeldOut(noisy.robot, noisy.space, [noisy.heldout], threads=1)
    truth = (noisy.theta, noisy.latency_s)
    errors = held_out.errors({"nominal": (noisy.space.nominal, 0.0), "truth": truth})
    assert np.all(errors.rmse["truth"] > 0.9 * errors.noise)
    assert np.all(errors.rmse["truth"] < 3 * errors.noise)
    assert np.all(errors.rmse["nominal"] > 3 * errors.noise)
    written = errors.to_json()
    assert written["unit"] == {"cart": "m", "pole": "rad"}
    assert written["noise"]["nrmse"] == pytest.approx(np.mean(errors.noise / errors.span))
    exact = HeldOut(noisy.robot, noisy.space, [noisy.heldout], threads=1, truth=[noisy.heldout_truth])
    assert exact.errors({"truth": truth}).to_json()["noise"]["mean"] is None


@pytest.mark.slow
def test_a_longer_window_that_is_refused_is_kept_as_such(
    monkeypatch: pytest.MonkeyPatch, small_problem: Callable[..., Problem]
) -> None:
    """The model errs there, also where noise explains the kept windows. Then no tick is whole."""
    problem = small_problem(fixed_latency_s=None)
    kept = refine(problem, problem.space.nominal, problem.first_latency_s, (0.2,))
    monkeypatch.setattr(refinement, "WORSE", 0.0)
    found = refine(problem, problem.space.nominal, problem.first_latency_s, (0.2, 0.4))
    assert np.array_equal(found.theta, kept.theta) and kept.refused is None
    assert found.refused is not None and found.refused.shooting.length == 2 * found.shooting.length
    assert doubtful(found) and doubtful(kept) == unexplained(kept)
    rng = np.random.default_rng(0)
    run = CalibrationRun(
        problem=problem,
        budget=Budget(),
        rng=rng,
        attempts=Restarts(FixedSearch(problem.space.nominal, 0.0, 0.05), rng, None),
        settings=Validation(split_half=False, physics_step=False, diagnosis=False),
        first_steps=problem.steps,
    )
    whole, free = (conclude_fit(run, None, fit) for fit in (kept, found))
    assert "latency_scan" in whole.facts and "latency_scan" not in free.facts


@pytest.mark.slow
def test_a_residual_that_no_drawn_point_lowers_is_the_models(small_problem: Callable[..., Problem]) -> None:
    """With a wrong latency forced on it nothing explains the data: one brief search, and an alarm."""
    problem = small_problem(fixed_latency_s=0.02)
    search = FixedSearch(problem.space.nominal, 0.021, 0.05)
    method = CalibrationPipeline(search, fits=Refinement(RestartSettings(drawn=1)))
    result = method.run(problem, Budget(), np.random.default_rng(0))
    assert [budget.brief for budget in search.budgets] == [True]
    assert any("does not explain" in alarm.means for alarm in result.alarms)


def test_filled_gaps_are_no_measurements() -> None:
    """Interpolated samples, which are not fitted, change neither chi2's count nor the autocorrelation."""
    white = np.random.default_rng(0).standard_normal((40, 201, 1))
    whole = white[:, 1:] + white[:, :-1]
    lost = np.where(np.random.default_rng(1).random(whole.shape) < 0.4, 0.0, whole)
    assert correlation_time((lost,)) == pytest.approx(correlation_time((whole,)), abs=0.1)
    assert correlated_samples([lost], 1) == pytest.approx(correlated_samples([whole], 1), abs=0.1)


def test_chi2_counts_only_reported_samples(noisy_problem: Problem) -> None:
    """With a third of the samples lost, the count of residuals is a third smaller, not the same."""
    whole = Shooting(noisy_problem, 20)
    lost = [np.arange(d.std.shape[1]) % 3 == 1 for d in whole.data]
    data = [
        dataclasses.replace(d, std=np.where(m[:, None], np.inf, d.std))
        for d, m in zip(whole.data, lost, strict=True)
    ]
    part = whole.on(data)
    counts = [s.normal(s.start(noisy_problem.space.nominal, 0.0)).count for s in (whole, part)]
    missing = sum(np.isinf(d.std).sum() for d in data)
    assert counts[0] - counts[1] == missing > 0.3 * counts[0]


def test_correlation_time_by_hand() -> None:
    """White residuals have time 1; a moving sum of two has rho_1 = 1/2 and so time 2."""
    rng = np.random.default_rng(0)
    white = rng.normal(size=(20, 200, 1))
    assert correlation_time((white,)) == pytest.approx(1.0, abs=0.1)
    assert correlation_time((white[:, 1:] + white[:, :-1],)) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize(("terms", "least", "most"), [(2, 0.0, 0.1), (4, 0.95, 1.0)])
def test_an_alarm_of_autocorrelation_is_no_chance(terms: int, least: float, most: float) -> None:
    """Twelve channels at the limit, time 2, hardly ever exceed it beyond chance; of time 4, always."""
    white = np.random.default_rng(0).standard_normal((40, 20, 99 + terms, 12))
    alarms = []
    for w in white:
        summed = np.sum([w[:, k : k + 100] for k in range(terms)], axis=0)
        alarms.append(correlation_time((summed,), FALSE_ALARMS) > CORRELATION_SAMPLES)
    assert least <= np.mean(alarms) <= most


@given(st.integers(0, 2**32 - 1))
def test_many_short_recordings_are_no_less_white_than_a_long_one(seed: int) -> None:
    """Ten of 480 samples: the worst of ten is beyond two standard errors now and then, not all together."""
    white = np.random.default_rng(seed).normal(size=(10, 3, 160, 2))
    assert correlation_time(tuple(white)) < WHITE_SAMPLES


def _two(low: float = 0.2, high: float = 5.0) -> ParameterSpace:
    return ParameterSpace(
        Parameter(name=n, kind="body_mass", elements=("cart",), unit="kg", nominal=1.0, low=low, high=high)
        for n in ("a", "b")
    )


def _unseen(space: ParameterSpace, hessian: FloatArray) -> tuple[str, ...]:
    return null_directions(space, null_space(space, hessian))


def test_null_direction_names_the_common_factor() -> None:
    """Information on ln a - ln b alone leaves a common factor open; on ln a + ln b: one up, one down."""
    (words,) = _unseen(_two(), 1e6 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    assert "common factor" in words and "a" in words and "b" in words
    (words,) = _unseen(_two(), 1e6 * np.array([[1.0, 1.0], [1.0, 1.0]]))
    assert "raised while" in words
    (words,) = _unseen(_two(), np.diag([1e6, 0.0]))
    assert words.startswith("b leaves no trace")
    assert _unseen(_two(), np.diag([1e6, 1e6])) == ()
    # Two directions that differ by 5 % of a: "b leaves no trace" once.
    same = NullSpace(np.array([[0.05, 1.0], [-0.05, 1.0]]), np.ones(2))
    assert null_directions(_two(), same) == (words,)
    # Both alone: one sentence names them.
    (both,) = null_directions(_two(), NullSpace(np.eye(2), np.ones(2)))
    assert both == "a, b leave no trace in this recording: excite them or measure them by other means"


def test_k11_names_its_null_directions_on_real_information(noisy: Case) -> None:
    """With nothing weighed, two combinations are invisible; each names a mass, together nearly all."""
    space = parameter_space().with_ratio(5.0)
    problem = Problem(noisy.robot, space, [noisy.fit], threads=1)
    shooting = Shooting(problem, 80)
    assert noisy.truth is not None
    theta = np.array([noisy.truth.parameters[name] for name in space.names])
    start = shooting.start(theta, noisy.latency_s, [noisy.fit_truth])
    hessian = shooting.normal(start, stretch=NEAR_STRETCH, central=True).hessian
    words = _unseen(space, hessian[:-1, :-1])
    assert len(words) == 2
    assert all("mass" in text for text in words)
    assert sum(any(name in text for text in words) for name in space.names) >= 9
    # Measured with ruler and scale, nothing of that is left.
    k9 = noisy.space
    kept = [space.names.index(name) for name in k9.names]
    assert _unseen(k9, hessian[np.ix_(kept, kept)]) == ()


def test_intervals_of_what_the_data_cannot_see_are_the_ranges() -> None:
    """A parameter as uncertain as its range gets the range's own 90 %; one known to 1 % gets +-1.645 %."""
    space = _two()
    prior = space.width[0] ** 2 / 12
    got = intervals(space, np.array([1.0, 4.9]), np.diag([1e-4, prior]))
    assert got[0] == pytest.approx([np.exp(-0.016448536), np.exp(0.016448536)])
    assert got[1] == pytest.approx(space.unnormalize(np.array([[0.05, 0.05], [0.95, 0.95]]))[:, 1])


def test_a_parameter_at_its_bound_is_reported() -> None:
    """The alarm names the parameter and says to widen the range."""
    space = _two()
    residual = (np.random.default_rng(0).normal(size=(4, 50, 2)),)
    noted = uncertainty(
        space,
        np.array([1.0, 5.0]),
        0.01,
        Normal(1.0, 1, np.diag([1e4, 1e4, 1e8]), np.zeros(3), residual, np.zeros(3)),
        1.0,
        (0.0, 0.04),
        kinks=1.2,
    )
    assert any("bound of the search range: b (5 kg)" in alarm.seen for alarm in noted.alarms)
    assert noted.verdicts == ("identifiable", "identifiable")


def test_scores_by_hand() -> None:
    """Estimates 1.1 and 0.5 of truth 1: 30 %, 100 (ln 1.1 + ln 2) / 2 = 39.42; half of the intervals hold."""
    theta, truth = np.array([1.1, 0.5]), np.ones(2)
    assert error_percent(theta, truth) == pytest.approx(30.0)
    assert log_error_x100(theta, truth) == pytest.approx(39.423, abs=1e-3)
    coverage90, width90 = interval_score(
        _two(), np.array([[0.9, 1.2], [0.4, 0.6]]), truth, np.array([0.1, 0.1])
    )
    assert coverage90 == 0.5
    widths = np.log(1.2 / 0.9), np.log(0.6 / 0.4)
    assert width90 == pytest.approx(np.median(widths) / (2 * 1.6448536 * 0.1))


def test_recording_without_excitation_is_refused_before_any_search(ideal: Case) -> None:
    """A robot that stands still is refused, and the message says what to record."""
    import dataclasses

    still = dataclasses.replace(ideal.fit, position=np.zeros_like(ideal.fit.position))
    problem = Problem(ideal.robot, ideal.space, [still], threads=1)
    search = FixedSearch(ideal.theta, 1e-3, 0.05)
    with pytest.raises(InsufficientDataError, match=r"hardly moves.*--motion rich"):
        CalibrationPipeline(search).run(problem, Budget(), np.random.default_rng(0))
    assert search.budgets == []
    short = dataclasses.replace(ideal.fit, usable=np.arange(len(ideal.fit.sample)) < 30)
    with pytest.raises(InsufficientDataError, match=r"0\.15 s of usable samples"):
        check_excitation(Problem(ideal.robot, ideal.space, [short], threads=1))


def test_a_recording_without_usable_samples_does_no_harm(ideal: Case) -> None:
    """Beside another that moves: such as a walk's part in which the robot only stands up."""
    unusable = dataclasses.replace(ideal.fit, usable=np.zeros(len(ideal.fit.sample), dtype=bool))
    check_excitation(Problem(ideal.robot, ideal.space, [ideal.fit, unusable], threads=1))


def test_diverged_members_are_nan_and_the_others_untouched() -> None:
    """A state that MuJoCo calls unstable is reported, not silently reset."""
    robot, space = load_model(DESCRIPTION), k9_space()
    batch = ServoBatch(robot, space, 2, threads=1)
    batch.set_state(np.array([[0.0, 0.1], [0.0, 0.1]]), np.array([[0.0, 0.0], [1e12, 0.0]]))
    position, _ = batch.advance(np.zeros((2, 50, 1)), every=10)
    assert np.isfinite(position[0]).all()
    assert np.isnan(position[1]).all()


def test_latency_scan_weighs_ticks_by_their_cost(ideal: Case) -> None:
    """Costs 10 and 12 at chi2 1 weigh 1 : exp(-1)."""
    problem = Problem(ideal.robot, ideal.space, [ideal.fit], threads=1)
    at = refine(problem, ideal.theta, 0.0, (0.2,), iterations=1)
    import dataclasses

    costs = [
        dataclasses.replace(at, chi2=1.0, normal=dataclasses.replace(at.normal, cost=c)) for c in (12.0, 10.0)
    ]
    scan = LatencyScan((4, 5), tuple(costs))
    assert scan.best == 1
    assert scan.weights == pytest.approx(np.array([np.exp(-1), 1.0]) / (1 + np.exp(-1)))
