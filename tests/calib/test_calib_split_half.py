"""Agreement of halves and null directions of K11, on recordings of the real device core, truths hidden."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.bench.tasks import Case, make_case
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.data.resume import Restarts
from deal_hw.calib.fit.intervals import NEAR_STRETCH, Uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.calib.hypotheses import diagnosis, trials
from deal_hw.calib.pipeline.calibration_run import AFTER_FIT, CalibrationRun
from deal_hw.calib.pipeline.stages import report_unidentifiable
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation import checks
from deal_hw.calib.validation.checks import (
    HALVES,
    SplitHalf,
    agreement,
    check_split_half,
    half_of,
    hold_windows,
    judge,
    widened_by_split_half,
)
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import BEFORE_SEARCH, Z90, Budget, Progress
from deal_hw.drivers.cartpole.description import parameter_space
from deal_hw.findings import SafeChecks


def test_halves_share_no_window_and_hold_all(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Blocks of two windows go to either half in turn, with their start states."""
    whole_fit = with_rows(noisy_refined)
    halves = [half_of(whole_fit, half, 2) for half in range(2)]
    starts = [set(h.shooting.data[0].windows.start.tolist()) for h in halves]
    assert not starts[0] & starts[1]
    assert starts[0] | starts[1] == set(noisy_refined.shooting.data[0].windows.start.tolist())
    whole = noisy_refined.shooting.cost(noisy_refined.point)
    assert sum(h.shooting.cost(h.point) for h in halves) == pytest.approx(whole)
    first = halves[0].shooting.data[0]
    assert len(first.measured) == len(first.windows) == len(halves[0].point.position[0])
    for half in halves:
        alone = half.shooting.normal(half.point, stretch=NEAR_STRETCH, central=True)
        assert half.normal.count == alone.count
        assert half.normal.cost == pytest.approx(alone.cost)
        # Along directions that they hardly show, both have other derivatives, each exact.
        np.testing.assert_allclose(np.diag(half.normal.hessian), np.diag(alone.hessian), rtol=0.05)


def test_halves_of_a_right_model_agree(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """No parameter is flagged, estimates lie inside their intervals, the JSON gives the rows back."""
    known = uncertainty_at(noisy_problem, noisy_refined, fixed_latency=True)
    split = check_split_half(noisy_problem, noisy_refined, known)
    assert split.flagged == () and split.alarms(noisy_problem.space) == () and split.steps > 0
    assert [r.name for r in split.rows] == list(noisy_problem.space.names)
    for row in split.rows:
        for estimate, low, high in (row.first, row.second):
            assert estimate is None or low <= estimate <= high
    assert set(split.to_json()["parameters"]) == set(noisy_problem.space.names)
    assert _widened(known, split) is known


def _widened(known: Uncertainty, split: SplitHalf, latency_s: float = 0.012) -> Uncertainty:
    return widened_by_split_half(known, split, latency_s, (0.0, 0.04))


def test_a_half_that_cannot_tell_a_parameter_gives_it_no_value(
    noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """Its interval is the range's own 90 %, which need not hold the estimate: no value, and no comparison."""
    problem, K = noisy_problem, len(noisy_problem.space)
    known = uncertainty_at(problem, noisy_refined, fixed_latency=True)
    ends = np.stack([problem.space.unnormalize(np.full(K, u)) for u in (0.05, 0.95)], axis=1)
    blind = dataclasses.replace(known, interval=ends, blind=np.ones(K, dtype=bool))
    low = problem.space.unnormalize(np.full(K, 0.01))
    split = agreement(known, [(low, 0.0), (noisy_refined.theta, 0.0)], [blind, known], None, 0)
    assert all(row.first[0] is None and row.second[0] is not None for row in split.rows)
    assert all(row.agree is None for row in split.rows) and split.flagged == ()
    assert split.to_json()["parameters"][problem.space.names[0]]["agree"] is None
    # The same two estimates from halves that tell them disagree, and are flagged.
    tight = dataclasses.replace(known, interval=np.stack([low, 1.01 * low], axis=1))
    split = agreement(known, [(low, 0.0), (noisy_refined.theta, 0.0)], [tight, known], None, 0)
    assert all(row.agree is False for row in split.rows)
    reported = np.array(problem.space.names)[~known.blind]
    assert set(split.flagged) <= set(reported) and "servo.stiffness" in split.flagged
    assert "(" in split.alarms(problem.space)[0].seen


def test_halves_of_two_robots_are_flagged_and_the_interval_holds_both(
    noisy: Case, noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """A half whose stiffness lies ten standard deviations off: its interval reaches it, with an alarm."""
    known = uncertainty_at(noisy_problem, noisy_refined, fixed_latency=True)
    k = noisy_problem.space.names.index("servo.stiffness")
    std = np.sqrt(known.covariance[k, k])
    far = noisy_problem.space.to_scale(noisy_refined.theta)
    far = noisy_problem.space.from_scale(far + 10 * std * np.eye(len(noisy_problem.space))[k])[k]
    reach = np.zeros(len(noisy_problem.space))
    reach[k] = 10 * std
    wide = _widened(known, SplitHalf((), ("servo.stiffness",), np.append(reach, 0.0)))
    assert wide.interval[k, 1] == pytest.approx(far)
    assert wide.interval[0] == pytest.approx(known.interval[0])
    assert any("disagree about servo.stiffness" in alarm.seen for alarm in wide.alarms)


def test_halves_that_differ_more_than_intervals_expect_widen_all_of_them(
    noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """Each half is off by 2.1 standard deviations, to either side: 2.97 times the expected distance."""
    problem, theta = noisy_problem, noisy_refined.theta
    known = uncertainty_at(problem, noisy_refined, fixed_latency=True)
    std, at = np.sqrt(np.diag(known.covariance)), problem.space.to_scale(theta)
    reported = ~known.blind

    def halves(off: float) -> list[Member]:
        return [(problem.space.from_scale(at + side * off * std * reported), 0.01) for side in (-1, 1)]

    wide = dataclasses.replace(known, interval=np.stack([problem.space.low, problem.space.high], axis=1))
    split = agreement(known, halves(2.1), [wide, wide], None, 0)
    assert split.flagged == () and split.scale == pytest.approx(2.1 * np.sqrt(2), rel=1e-6)
    assert split.to_json()["scale"] == split.scale
    wider = _widened(known, split, noisy_refined.latency_s)
    assert np.sqrt(np.diag(wider.covariance)) == pytest.approx(split.scale * std)
    # A given latency has no interval.
    assert wider.latency_interval_s == known.latency_interval_s
    by_chance = agreement(known, halves(0.7), [wide, wide], None, 0)
    assert by_chance.scale == 1.0 and _widened(known, by_chance) is known


def test_halves_disagree_about_the_latency_like_about_any_value(
    noisy_problem: Problem, noisy_refined: Refined
) -> None:
    """By hand: 10 and 16 ms, with reaches of 1 ms each: the interval of +-1 ms around 12 ms holds both.

    Where all values differ by more than chance, it is wider by the same factor, and its range cuts it off.
    """
    theta, known = noisy_refined.theta, uncertainty_at(noisy_problem, noisy_refined)
    known = dataclasses.replace(known, latency_interval_s=(0.011, 0.013))
    of_half = [dataclasses.replace(known, latency_interval_s=(t - 1e-3, t + 1e-3)) for t in (0.010, 0.016)]
    split = agreement(known, [(theta, 0.010), (theta, 0.016)], of_half, 0.012, 0)
    assert split.flagged == ("latency",) and split.reach[-1] == pytest.approx(0.004)
    assert "latency (10 and 16 ms)" in split.alarms(noisy_problem.space)[0].seen
    assert _widened(known, split, 0.012).latency_interval_s == pytest.approx((0.008, 0.016))
    reach = np.zeros(len(theta) + 1)
    three = SplitHalf((), (), reach, scale=3.0)
    assert _widened(known, three, 0.012).latency_interval_s == pytest.approx((0.009, 0.015))
    late = dataclasses.replace(known, latency_interval_s=(0.036, 0.04))
    assert _widened(late, three, 0.039).latency_interval_s == pytest.approx((0.030, 0.04))


def test_intervals_hold_what_other_windows_say(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Stiffness five standard deviations lower in other windows: its interval reaches there, but for one.

    By hand: what exceeds their own standard deviation, sqrt(25 - 1) of it, is added.
    """
    known = uncertainty_at(noisy_problem, noisy_refined, fixed_latency=True)
    space, std = noisy_problem.space, np.sqrt(np.diag(known.covariance))
    k = space.names.index("servo.stiffness")
    short = dataclasses.replace(noisy_refined, normal=dataclasses.replace(noisy_refined.normal, rows=()))
    own = float(np.sqrt(uncertainty_at(noisy_problem, short).covariance[k, k]))
    at = space.to_scale(noisy_refined.theta) - 5.0 * own * np.eye(len(space))[k]
    short = dataclasses.replace(short, theta=space.from_scale(at))
    wrong = dataclasses.replace(noisy_refined, chi2=2.0, shorter=short)
    wide = hold_windows(known, wrong.latency_s, wrong)
    expected = std.copy()
    expected[k] += np.sqrt(5.0**2 - 1.0) * own / Z90
    assert np.sqrt(np.diag(wide.covariance)) == pytest.approx(expected, rel=1e-3)
    assert wide.latency_interval_s == known.latency_interval_s
    # Shorter windows that are explained worse ended in another minimum.
    other = dataclasses.replace(wrong, shorter=dataclasses.replace(short, chi2=3.0))
    same = hold_windows(known, wrong.latency_s, other)
    assert np.sqrt(np.diag(same.covariance)) == pytest.approx(std)
    # Longer windows that were refused; those with a residual that is larger by far ended elsewhere.
    for chi2, reach in ((short.chi2, expected), (30.0, std)):
        refused = dataclasses.replace(short, chi2=chi2)
        held = hold_windows(known, wrong.latency_s, dataclasses.replace(noisy_refined, refused=refused))
        assert np.sqrt(np.diag(held.covariance)) == pytest.approx(reach, rel=1e-3)


def test_too_few_windows_are_not_halved(noisy: Case, noisy_problem: Problem, noisy_refined: Refined) -> None:
    """Three windows: a note instead of rows."""
    few = dataclasses.replace(noisy.fit, usable=np.arange(len(noisy.fit.sample)) < 130)
    short = Problem(noisy.robot, noisy.space, [few], threads=1, fixed_latency_s=noisy.latency_s)
    found = refine(short, noisy.theta, noisy.latency_s, (0.2,), iterations=1)
    split = check_split_half(short, found, uncertainty_at(short, found, fixed_latency=True))
    assert split.rows == () and "too few" in split.note


@pytest.mark.slow
@pytest.mark.parametrize(("profile", "seed"), [("ideal", 0), ("sensor", 0), ("sensor", 2)])
def test_k11_gives_no_value_to_what_its_null_directions_move(profile: str, seed: int) -> None:
    """Two exact null directions are named, nearly all parameters have no value, their intervals the range.

    Without noise, too, where the truncation of a one-sided difference would look like information.
    """
    case = make_case("cartpole", profile, seed, 5.0)
    space = parameter_space().with_ratio(5.0)
    assert case.truth is not None
    theta = np.array([case.truth.parameters[name] for name in space.names])
    problem = Problem(case.robot, space, [case.fit], threads=1, fixed_latency_s=case.latency_s)
    found = with_rows(refine(problem, theta, case.latency_s, (0.2, 0.4)))
    known = uncertainty_at(problem, found, fixed_latency=True)
    known, _ = judge(problem, found, known, Validation(), safely=SafeChecks())
    assert len(known.null_directions) == 2
    # The same is reported before a search begins.
    printed: list[Progress] = []
    report_unidentifiable(problem, found, printed.append)
    assert [p.stage for p in printed] == [BEFORE_SEARCH]
    assert printed[0].message.count("measure one of them") == 2
    named = [n for n in space.names if any(n in words for words in known.null_directions)]
    without = [n for n, v in zip(space.names, known.verdicts, strict=True) if v == "not identifiable"]
    assert {"cart.mass", "pole.mass", "pole.length", "servo.stiffness"} <= set(without)
    assert set(without) <= set(named)
    # Ratios of rates are reported whatever the scale of forces is.
    assert known.verdicts[space.names.index("servo.speed_limit")] == "identifiable"
    for n in without:
        k = space.names.index(n)
        assert known.interval[k] == pytest.approx(
            [space.unnormalize(np.full(len(space), u))[k] for u in (0.05, 0.95)]
        )
        assert known.interval[k, 0] <= theta[k] <= known.interval[k, 1]


def test_checks_take_no_more_steps_than_the_fits(noisy_problem: Problem, noisy_refined: Refined) -> None:
    """What fits in runs and is counted; what does not is named, unless all checks are asked for."""
    rng = np.random.default_rng(0)
    problem = noisy_problem
    run = CalibrationRun(
        problem=problem,
        budget=Budget(population=20, generations=4),
        rng=rng,
        attempts=Restarts(Eki(), rng, None),
        settings=Validation(diagnosis=False),
        first_steps=problem.steps,
    )
    shooting, K = noisy_refined.shooting, len(problem.space)
    here = noisy_refined.point
    # Predictions at a point that was simulated are kept.
    shooting.residuals(dataclasses.replace(here, value=here.value + 1e-9))
    fits = problem.steps - run.first_steps
    assert run.fit_steps == fits > 0 and run.allows("a", fits) and not run.allows("b", fits + 1)
    assert list(run.left_out) == ["b"]
    with run.check("a"):
        shooting.residuals(dataclasses.replace(here, value=here.value + 2e-9))
        # A check that is running counts already.
        assert run.fit_steps == fits and run.check_steps_left == 0 and not run.allows("c", 1)
    assert run.checks == {"a": fits} and run.check_steps_left == 0
    # Searches of an earlier process are fits, so that a resumed run makes the same checks.
    run.attempts.earlier_steps = 1000
    assert run.fit_steps == fits + 1000 and run.allows("d", 1000)

    known = uncertainty_at(problem, noisy_refined, fixed_latency=True)
    run.attempts.earlier_steps = 0
    with run.check(AFTER_FIT):
        kept, facts = judge(problem, noisy_refined, known, run.settings, allows=run.allows, safely=run.safely)
    assert "left out" in facts["split_half"]["note"] and HALVES in run.left_out
    assert len(kept.verdicts) == K
    thorough = dataclasses.replace(run, settings=Validation(thorough=True))
    assert thorough.allows(HALVES, 1e12)


def test_causes_come_before_halves(
    noisy_problem: Problem, noisy_refined: Refined, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They say what to do, so they are asked for first; what is refused is not simulated."""
    asked: list[str] = []

    def refuse(name: str, steps: float) -> bool:
        assert steps > 0
        asked.append(name)
        return False

    for module in (diagnosis, trials):
        monkeypatch.setattr(module, "fit_wider", lambda *_: pytest.fail("a wider model was fitted"))
    wrong = dataclasses.replace(noisy_refined, chi2=5.0)
    known = uncertainty_at(noisy_problem, wrong, fixed_latency=True)
    settings = Validation(physics_step=False)
    _, facts = judge(noisy_problem, wrong, known, settings, allows=refuse, safely=SafeChecks())
    assert asked[-1] == HALVES and len(asked) > 1
    assert "diagnosis" in facts and "left out" in facts["split_half"]["note"]


def test_a_check_that_raises_is_named_and_changes_nothing(
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
    checks_may_fail: None,
) -> None:
    """Without causes it is not said that there are none; intervals and values stay those of the fit."""

    def broken(*_: object) -> None:
        raise FloatingPointError("broken")

    for name in ("with_step", "diagnose", "check_split_half"):
        monkeypatch.setattr(checks, name, broken)
    wrong = dataclasses.replace(noisy_refined, chi2=5.0)
    known, safely = uncertainty_at(noisy_problem, wrong, fixed_latency=True), SafeChecks()
    found, facts = judge(noisy_problem, wrong, known, Validation(), safely=safely)
    assert list(safely.failed) == [checks.PHYSICS_STEP, checks.CAUSES, HALVES]
    assert all(why.startswith("FloatingPointError: broken (test_calib") for why in safely.failed.values())
    assert not {"physics_step", "diagnosis", "candidates"} & set(facts)
    assert facts["split_half"] == {"note": "the check failed"}
    np.testing.assert_array_equal(found.interval, known.interval)
    assert found.alarms == known.alarms and len(safely.alarms) == 3
