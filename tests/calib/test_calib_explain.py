"""Laws that a model lacks, found by what they predict of motion that was not fitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fakes.law_robots import SERVO, robot
from fakes.plain_truth import refused, truth
from fakes.small_runs import small_run

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, with_rows
from deal_hw.calib.fit.refinement import at_parameters
from deal_hw.calib.pipeline.law_choice import LawCandidate, LawfulChoice, law_errors
from deal_hw.calib.pipeline.output_error_fits import OutputErrorFits
from deal_hw.calib.pipeline.stages import CalibrationPipeline, with_explanation
from deal_hw.calib.report.verdict import trust
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.cross_validation import Choice
from deal_hw.calib.validation.diagnosis import all_allowed, diagnose
from deal_hw.calib.validation.explain import DECISIVE, explained, try_explanations
from deal_hw.calib.validation.explanations import EXPLANATIONS
from deal_hw.calib.validation.explanations import PLAY as PLAY_LAW
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget
from deal_hw.parameters import ParameterSpace
from deal_hw.testing.plain_faults import PLAY, Fault
from deal_hw.workflows.calibration.run import calibrate_episodes


@pytest.mark.slow
def test_another_minimum_is_no_play() -> None:
    """A right model, and a local fit that ended elsewhere: the wider fit finds the truth, without play."""
    _, problem, fit = truth("pendulum", None)
    elsewhere = with_rows(at_parameters(problem, 1.5 * fit.theta, fit.latency_s + 0.008, fit.shooting.length))
    assert elsewhere.chi2 > 10 * fit.chi2
    assert explained(problem, elsewhere, try_explanations(problem, elsewhere, all_allowed)) == []


@pytest.mark.slow
def test_play_is_found_and_measured() -> None:
    """A gear with 0.06 rad of play: refitted with play in it the model predicts the rest to the noise.

    The fit with play is the expensive part: one of this problem is taken, that of another is not.
    """
    _, problem, fit = truth("pendulum", "backlash")
    tried = try_explanations(problem, fit, all_allowed)
    assert tried[0].explanation is PLAY_LAW and tried[0].wider is not None
    assert try_explanations(problem, fit, refused, tried) == tried
    (again, *_) = try_explanations(dataclasses.replace(problem), fit, refused, tried)
    assert again.explanation is PLAY_LAW and again.wider is None
    found = explained(problem, fit, tried)[0]
    assert found.explanation is PLAY_LAW and found.explains
    cause = found.diagnosis
    assert cause.code == "backlash" and cause.subject == ("pivot",)
    assert "0.06 rad at pivot" in cause.seen and "servo_play" in cause.do
    assert cause.share > DECISIVE


@pytest.mark.slow
def test_play_that_explains_all_becomes_a_parameter() -> None:
    """No search follows; the result has the play, the true values, and one alarm.

    The search that is not needed is long enough to try play in its place.
    """
    robot, problem, _ = truth("pendulum", "backlash")
    result = calibrate_episodes(
        problem.robot,
        problem.space,
        problem.episodes,
        problem.episodes[:1],
        method="default",
        budget=Budget(population=20, generations=5),
        rng=np.random.default_rng(0),
        threads=1,
    )
    assert result.space.names == (*problem.space.names, "pivot.play") and result.steps < 5_000_000
    assert result.provenance["search"] == "local fit" and result.chi2 < MISMATCH_CHI2
    true = np.array([robot.truth.get(name, PLAY) for name in result.space.names])
    np.testing.assert_allclose(result.estimate[-1], PLAY, rtol=0.02)
    inside = (result.interval[:, 0] <= true) & (true <= result.interval[:, 1])
    assert inside.mean() >= 0.75
    (alarm,) = [one for one in result.alarms if "play" in one.seen]
    assert "it has the play as pivot.play" in alarm.do
    assert result.heldout_nrmse["calibrated"] < 0.1 * result.heldout_nrmse["nominal"]
    assert trust(result).colour == "amber"
    asked = result.restricted(problem.space)
    assert asked.space.names == problem.space.names and len(asked.verdicts) == len(asked.estimate)
    np.testing.assert_array_equal(asked.distribution().mean, result.distribution().mean[:-1])


@pytest.mark.slow
def test_friction_at_rest_is_found_as_a_law() -> None:
    """A robot with four times the friction at rest, by a force of its own: the law predicts it best.

    Neither play nor a lag nor load does, so none of them is named.
    """
    robot, problem, fit = truth("pendulum", "friction")
    tried = try_explanations(problem, fit, all_allowed)
    found = explained(problem, fit, tried)
    assert [one.explanation.name for one in found] == ["friction that falls with speed"]
    best = found[0]
    assert best.added == ("pivot.friction_stribeck", "pivot.stribeck_speed")
    assert best.chi2 < 0.5 * best.before and best.diagnosis.code == "friction"
    # Three times the friction in motion is missing; its fall with speed has another shape.
    value = best.theta[best.problem.space.names.index("pivot.friction_stribeck")]
    assert value == pytest.approx(3 * robot.truth["pivot.frictionloss"], rel=0.5)
    causes = diagnose(problem, fit, tried).causes
    assert causes[0].code == "friction" and "dof_friction_stribeck" in causes[0].do


@pytest.mark.slow
def test_a_heavier_link_is_no_law_of_friction() -> None:
    """The mass explains more than a load would: the law is not even fitted."""
    _, problem, fit = truth("double-pendulum", "mass")
    tried = {one.explanation.name: one for one in try_explanations(problem, fit, all_allowed)}
    load = tried["friction that grows with load"]
    assert load.wider is None


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "law"), [("friction", "friction that falls with speed"), ("mass", None)])
def test_a_law_is_taken_for_what_it_predicts(fault: Fault | None, law: str | None) -> None:
    """As on a real robot: no fit need explain all. Friction at rest is taken; a mass or nothing is no law."""
    _, problem, _ = truth("double-pendulum", fault)
    K = len(problem.space)
    method = CalibrationPipeline(
        Eki(), "output-error", Validation(local_first=False, split_half=False), fits=OutputErrorFits()
    )
    found = method.run(problem, Budget(population=20, generations=4), np.random.default_rng(0))
    assert len(found.estimate) == len(found.space) and found.space.names[:K] == problem.space.names
    folds = found.provenance["cross_validation"]["errors"]
    if law is None:
        assert "law" not in found.provenance and len(found.space) == K
        return
    of = found.provenance["law"]
    assert of["law"] == law and f"long, {law}" in folds
    assert max(of["error_ratio"]) < 0.9
    assert found.space.names[K:] == tuple(of["values"]) and len(of["values"]) == 4
    assert found.estimate[K:] == pytest.approx(list(of["values"].values()))
    assert found.population is None
    (alarm,) = [one for one in found.alarms if "falls with speed" in one.seen]
    assert "elbow.friction_stribeck" in alarm.do


@pytest.mark.slow
def test_without_laws_a_law_is_only_named() -> None:
    """Who wants a result that plain MuJoCo runs gets one."""
    _, problem, fit = truth("pendulum", "backlash")
    run = small_run(
        problem,
        settings=Validation(laws=False),
        local=with_rows(fit),
        tried=try_explanations(problem, with_rows(fit), all_allowed),
    )
    assert with_explanation(run) is None
    taken = with_explanation(dataclasses.replace(run, settings=Validation()))
    assert taken is not None and len(taken.theta) > len(problem.space)


def test_a_law_must_predict_every_fold() -> None:
    """A mean that one fold makes is no evidence; a law that wins each fold is taken."""
    law = LawCandidate(PLAY_LAW, (), (0.4, 2.0), (np.zeros(0), 0.0))
    short, long = law.names
    plain = Choice("long", {"short": (3.0, 1.9), "long": (2.0, 2.0)}, 2.0)
    mixed = LawfulChoice.of(plain, [law], {short: [2.5], long: [1.0, 1.95]})
    assert mixed.law is None and mixed.made == plain
    assert mixed.to_json()["lost"] == {short: [2.5], long: [1.0, 1.95]}
    won = LawfulChoice.of(plain, [law], {short: [2.5], long: [1.0, 1.52]})
    assert won.law is law and won.ratios == pytest.approx([0.5, 0.8])
    assert won.made.chosen == long and set(won.made.errors) == {"short", "long", long}
    assert LawfulChoice.of(plain, [], {}) == LawfulChoice(plain)


def test_a_law_that_loses_a_fold_is_fitted_to_no_other(
    small_problem: Callable[..., Problem], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The short fit loses at once, and the long one in the second fold, so there is no third."""
    problem = small_problem()
    law, folds = LawCandidate(PLAY_LAW, (), (0.4, 2.0), (np.zeros(0), 0.0)), list[tuple[int, str]]()
    masks = [[np.arange(len(e.sample)) % 3 == k for e in problem.episodes] for k in range(3)]
    start = problem.space.nominal, 0.0
    monkeypatch.setattr(LawCandidate, "members", lambda *_, **__: dict.fromkeys(law.names, start))
    plain = Choice("long", {"short": (3.0, 3.0, 3.0), "long": (2.0, 2.0, 2.0)}, 2.0)
    judged = iter([[2.5, 1.0], [1.0, 2.5]])

    def errors(*_: Any) -> Any:
        return np.array(next(judged))

    found = law_errors(problem, masks, [law], plain, errors, lambda *now: folds.append(now))
    assert found == {law.names[0]: [2.5], law.names[1]: [1.0, 2.5]} and folds == [
        (0, PLAY_LAW.name),
        (1, PLAY_LAW.name),
    ]


def test_a_lag_is_tried_from_the_filter_of_the_mjcf(tmp_path: Path) -> None:
    """That acts already, with its time constant: from another one the candidate would begin worse."""
    text = SERVO.replace('joint="elbow" kp="10"', 'joint="elbow" timeconst=".08" kp="10"')
    problem: Any = SimpleNamespace(robot=robot(tmp_path, text), space=ParameterSpace([]))
    (lags,) = (law.parameters(problem) for law in EXPLANATIONS if law.name == "drives that lag")
    assert [(p.elements, p.nominal, p.high) for p in lags] == [
        (("shoulder",), 0.005, 0.1),
        (("elbow",), 0.08, 0.16),
    ]
