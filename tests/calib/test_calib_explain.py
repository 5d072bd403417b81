"""Laws that a model lacks, found by what they predict of motion that was not fitted."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fakes.law_robots import SERVO, robot
from fakes.plain_truth import problem_of, refused, truth
from fakes.small_runs import small_run

from deal_hw.calib.data.folds import Choice
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import MISMATCH_CHI2, with_rows
from deal_hw.calib.fit.refinement import at_parameters, local_fit
from deal_hw.calib.hypotheses.diagnosis import all_allowed, diagnose
from deal_hw.calib.hypotheses.hypothesis import off_value, one_sided, tried_value, values_in_words
from deal_hw.calib.hypotheses.laws import HYPOTHESES
from deal_hw.calib.hypotheses.laws import PLAY as PLAY_LAW
from deal_hw.calib.hypotheses.thresholds import DECISIVE, FAR_CHI2
from deal_hw.calib.hypotheses.trials import applicable, explained, try_hypotheses
from deal_hw.calib.pipeline.attempts import with_explanation
from deal_hw.calib.pipeline.conclusion import without_search
from deal_hw.calib.pipeline.law_choice import (
    LawCandidate,
    LawfulChoice,
    LawsTaken,
    ScreenedLaws,
    law_errors,
)
from deal_hw.calib.pipeline.output_error_fits import BRIEF, OutputErrorFits
from deal_hw.calib.pipeline.stages import (
    CalibrationPipeline,
    far_from_noise,
    with_laws_tried,
)
from deal_hw.calib.report.verdict import trust
from deal_hw.calib.search.eki import Eki
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import Budget
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.testing import plain_effects
from deal_hw.testing.plain_faults import (
    ASYMMETRY,
    ENCODER_SCALE,
    FREE_SPEED,
    LAG_S,
    LAWS,
    LOAD_FRICTION,
    PLAY,
    SERVO_DEAD_ZONE,
    Fault,
)
from deal_hw.testing.plain_robots import make_robot
from deal_hw.workflows.calibration.intake import CalibrationInput
from deal_hw.workflows.calibration.run import calibrate_or_raise
from deal_hw.workflows.calibration.settings import CalibrateSettings

STRIBECK_LAW = next(law for law in HYPOTHESES if law.name == "friction that falls with speed")


@pytest.mark.slow
def test_another_minimum_is_no_play() -> None:
    """A right model, and a local fit that ended elsewhere: the wider fit finds the truth, without play."""
    _, problem, fit = truth("pendulum", None)
    elsewhere = with_rows(at_parameters(problem, 1.5 * fit.theta, fit.latency_s + 0.008, fit.shooting.length))
    assert elsewhere.chi2 > 10 * fit.chi2
    assert explained(problem, elsewhere, try_hypotheses(problem, elsewhere, all_allowed)) == []


@pytest.mark.slow
def test_play_is_found_and_measured() -> None:
    """A gear with 0.06 rad of play: refitted with play in it the model predicts the rest to the noise.

    The fit with play is the expensive part: one of this problem is taken, that of another is not.
    """
    _, problem, fit = truth("pendulum", "backlash")
    tried = try_hypotheses(problem, fit, all_allowed)
    assert tried[0].hypothesis is PLAY_LAW and tried[0].wider is not None
    assert try_hypotheses(problem, fit, refused, tried) == tried
    (again, *_) = try_hypotheses(dataclasses.replace(problem), fit, refused, tried)
    assert again.hypothesis is PLAY_LAW and again.wider is None
    found = explained(problem, fit, tried)[0]
    assert found.hypothesis is PLAY_LAW and found.explains
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
    work = CalibrationInput(
        robot=problem.robot, space=problem.space, episodes=problem.episodes, holdout=problem.episodes[:1]
    )
    settings = CalibrateSettings(population=20, generations=5, threads=1)
    result = calibrate_or_raise(settings, work, "default")
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
    tried = try_hypotheses(problem, fit, all_allowed)
    found = explained(problem, fit, tried)
    assert [one.hypothesis.name for one in found] == ["friction that falls with speed"]
    best = found[0]
    assert best.added == ("pivot.friction_stribeck", "pivot.stribeck_speed")
    assert best.chi2 < 0.5 * best.before and best.diagnosis.code == "friction"
    # Three times the friction in motion is missing; its fall with speed has another shape.
    value = best.theta[best.problem.space.names.index("pivot.friction_stribeck")]
    assert value == pytest.approx(3 * robot.truth["pivot.frictionloss"], rel=0.5)
    causes = diagnose(problem, fit, tried).causes
    assert causes[0].code == "friction" and "dof_friction_stribeck" in causes[0].do


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fault", "value"),
    [
        ("pendulum", "servo-dead-zone", SERVO_DEAD_ZONE),
        ("pendulum", "motor-dead-zone", 0.02),
        ("pendulum", "motor-asymmetry", ASYMMETRY),
        ("cart-pole", "encoder-scale", ENCODER_SCALE),
    ],
)
def test_an_effect_of_a_drive_or_an_encoder_is_found_and_measured(
    kind: str, fault: Fault, value: float
) -> None:
    """Beside every other law and cause, on 6 s of motion: the true value within a tenth of it.

    5 % of the pendulum's largest command, 0.4 N·m, is 0.02 N·m.
    """
    _, problem, _ = truth(kind, fault)
    local = local_fit(problem, lambda *_, **__: None)
    assert local is not None
    fit = with_rows(local)
    found = explained(problem, fit, try_hypotheses(problem, fit, all_allowed))[0]
    assert found.hypothesis.name in LAWS[fault] and found.chi2 < 0.5 * found.before
    assert found.theta[len(problem.space) :] == pytest.approx([value], rel=0.1)


@pytest.mark.slow
def test_friction_by_the_motors_torque_is_no_dead_zone() -> None:
    """0.2 of the torque; a dead zone below 0 would explain it to first order, but none is tried."""
    _, problem, fit = truth("pendulum", "load-friction")
    tried = try_hypotheses(problem, fit, all_allowed)
    assert {one.hypothesis.name: one.screened for one in tried}["servos with a dead zone"] == 0.0
    (found,) = explained(problem, fit, tried)
    assert found.hypothesis.name == "friction that grows with the motor's torque"
    assert found.theta[-1] == pytest.approx(LOAD_FRICTION, rel=0.1) and found.chi2 < 0.8 * found.before


def test_laws_are_those_that_a_robot_can_have(tmp_path: Path) -> None:
    """Servos have no command of a motor; a free speed needs a limit; a servo's loop hides an encoder's scale.

    A free speed begins at ten times the rms speed, with a hundredth of the effort lost at the largest one.
    """
    faults: Sequence[Fault] = ("free-speed", "motor-asymmetry", "lag")
    limited, motors, plain = (
        {
            law.name: more
            for law, more in applicable(problem_of(make_robot("pendulum", 3, f), tmp_path)).items()
        }
        for f in faults
    )
    of_motors = {"motors that do more to one side", "motors with a dead zone", "encoders with another scale"}
    of_servos = {"play in the gears", "servos with a dead zone"}
    assert of_motors <= set(motors) and of_servos.isdisjoint(motors)
    assert of_servos <= set(plain) and of_motors.isdisjoint(plain)
    assert set(limited) - set(plain) == {"effort that falls with speed"}
    (speed,) = limited["effort that falls with speed"]
    assert speed.low < speed.nominal < speed.high and speed.high / speed.nominal == pytest.approx(100 / 3)


def test_a_parameter_without_effect_at_an_end_moves_one_way(tmp_path: Path) -> None:
    """A lag of the MJCF may become shorter; an asymmetry and a scale go to both sides from the middle."""
    problem = problem_of(make_robot("pendulum", 3, "motor-asymmetry"), tmp_path)
    ways = {law.name: one_sided(problem, more).all() for law, more in applicable(problem).items()}
    both = ("motors that do more to one side", "encoders with another scale")
    assert ways == {name: name not in both for name in ways}
    scale = next(more[0] for law, more in applicable(problem).items() if law.name == both[1])
    assert off_value(scale) == 1.0 and tried_value(scale) == pytest.approx(1.01)
    filtered: Any = SimpleNamespace(robot=SimpleNamespace(filters="an MJCF's"))
    lag = Parameter.from_zero("a.lag", "command_lag", ("a",), "s", 0.005, 0.1)
    assert one_sided(problem, [lag]).all() and not one_sided(filtered, [lag]).any()


def test_a_value_of_0_is_not_told_beside_others() -> None:
    """A rotor's inertia that the fit leaves at 0 explains nothing; alone it is told."""
    cart, pole = (Parameter.around(f"{name}.armature", "dof_armature", (name,), "kg", 1.0) for name in "ab")
    assert values_in_words([cart, pole], [0.834, 0.0]) == "a.armature = 0.83 kg"
    assert values_in_words([cart, pole], [0.834, 0.2]) == "a.armature = 0.83 kg, b.armature = 0.2 kg"
    assert values_in_words([cart], [0.0]) == "a.armature = 0 kg"


@pytest.mark.slow
def test_a_heavier_link_is_no_law_of_friction() -> None:
    """The mass explains more than a load would: the law is not even fitted."""
    _, problem, fit = truth("double-pendulum", "mass")
    tried = {one.hypothesis.name: one for one in try_hypotheses(problem, fit, all_allowed)}
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
        assert "laws" not in found.provenance and len(found.space) == K
        return
    (of,) = found.provenance["laws"]
    assert of["law"] == law and f"long, {law}" in folds
    assert max(of["error_ratio"]) < 0.9
    assert found.space.names[K:] == tuple(of["values"]) and len(of["values"]) == 4
    assert found.estimate[K:] == pytest.approx(list(of["values"].values()))
    assert found.population is None
    (alarm,) = [one for one in found.alarms if "falls with speed" in one.seen]
    assert "elbow.friction_stribeck" in alarm.do


@pytest.mark.slow
def test_two_laws_are_taken_one_on_top_of_the_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A servo that lags, and whose friction is larger at rest: neither law alone is enough."""
    monkeypatch.setitem(plain_effects.FORCES, "lag", plain_effects.FORCES["friction"])
    problem = problem_of(make_robot("pendulum", 3, "lag"), tmp_path, seconds=6.0)
    method = CalibrationPipeline(
        Eki(), "output-error", Validation(local_first=False, split_half=False), fits=OutputErrorFits()
    )
    found = method.run(problem, Budget(population=20, generations=4), np.random.default_rng(0))
    first, second = found.provenance["laws"]
    assert (first["law"], second["law"]) == ("friction that falls with speed", "drives that lag")
    assert max(first["error_ratio"]) < 0.8 and max(second["error_ratio"]) < 0.6
    values = dict(zip(found.space.names, found.estimate, strict=True))
    assert values["pivot.lag"] == second["values"]["pivot.lag"] == pytest.approx(LAG_S, rel=0.02)
    assert values["pivot.friction_stribeck"] == first["values"]["pivot.friction_stribeck"] > 0.05
    named = [one for one in found.alarms if "left out is" in one.seen]
    assert len(named) == 2 and "pivot.lag" in named[1].do


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fault", "law"),
    [("pendulum", "friction", "friction that falls with speed"), ("double-pendulum", "mass", None)],
)
def test_a_law_is_taken_after_a_refinement_far_from_the_noise(
    kind: str, fault: Fault, law: str | None
) -> None:
    """As on a real arm that torques drive: fits of short predictions follow where the refinement ended."""
    _, problem, fit = truth(kind, fault)
    run = small_run(problem)
    found = BRIEF.continued(run, without_search(problem, run.budget, fit), fit)
    assert [one["law"] for one in found.facts.get("laws", ())] == ([law] if law else [])
    assert len(found.theta) == len(problem.space) + (2 if law else 0)
    if law is not None:
        assert max(found.facts["laws"][0]["error_ratio"]) < 0.6


@pytest.mark.slow
def test_laws_that_leave_only_noise_are_fitted_with_the_start_states(tmp_path: Path) -> None:
    """Truth recovery: free speeds of two motors within 2 %, where fits of predictions alone are 4 % off.

    Without the law inertia and damping take its place, so far from the truth that fits begin at the model's
    own values, too.
    """
    problem = problem_of(make_robot("double-pendulum", 3, "free-speed"), tmp_path)
    fit = local_fit(problem)
    assert fit is not None and fit.chi2 > 5
    run = small_run(problem)
    found = BRIEF.continued(run, without_search(problem, run.budget, fit), fit)
    (law,) = found.facts["laws"]
    assert law["law"] == "effort that falls with speed" and max(law["error_ratio"]) < 0.3
    assert found.chi2 < MISMATCH_CHI2 and found.space is not None
    values = dict(zip(found.space.names, found.theta, strict=True))
    assert law["values"] == {name: values[name] for name in ("shoulder.free_speed", "elbow.free_speed")}
    assert list(law["values"].values()) == pytest.approx([FREE_SPEED, FREE_SPEED], rel=0.02)
    assert found.facts["candidates"][0]["outcome"] == "taken"


def test_only_a_residual_far_from_the_noise_is_fitted_by_predictions() -> None:
    """Near it, and where nobody compares predictions, fitted start states tell more."""
    _, problem, fit = truth("pendulum", None)
    run, poor = small_run(problem), dataclasses.replace(fit, chi2=FAR_CHI2 + 1)
    assert far_from_noise(run, poor) and not far_from_noise(run, fit)
    unchecked = Validation(cross_validation=False)
    assert not far_from_noise(dataclasses.replace(run, settings=unchecked), poor)
    known = problem.on(problem.episodes, np.ones(2 * problem.coordinates))
    assert not far_from_noise(dataclasses.replace(run, problem=known), poor)


@pytest.mark.slow
def test_a_law_that_explains_all_is_in_the_result_after_a_search() -> None:
    """Laws are tried around the refinement: the local fit had ended elsewhere, or there was none."""
    _, problem, fit = truth("pendulum", "backlash")
    run = small_run(problem, settings=Validation(thorough=True))
    searched = without_search(problem, run.budget, fit)
    found = with_explanation(with_laws_tried(run, fit), searched)
    assert found is not None and found.searched is searched
    assert len(found.theta) > len(problem.space) and found.chi2 < MISMATCH_CHI2


def test_laws_are_tried_once_around_one_fit() -> None:
    """Nor where they are not asked for, or nothing is left to explain."""
    _, problem, fit = truth("pendulum", None)
    poor = dataclasses.replace(fit, chi2=2.0)
    run = small_run(problem, local=fit)
    assert with_laws_tried(run, poor) is run
    assert with_laws_tried(small_run(problem), dataclasses.replace(fit, chi2=0.9)).tried == ()
    unasked = small_run(problem, settings=Validation(diagnosis=False))
    assert with_laws_tried(unasked, poor) is unasked


@pytest.mark.slow
def test_without_laws_a_law_is_only_named() -> None:
    """Who wants a result that plain MuJoCo runs gets one."""
    _, problem, fit = truth("pendulum", "backlash")
    run = small_run(
        problem,
        settings=Validation(laws=False),
        local=with_rows(fit),
        tried=try_hypotheses(problem, with_rows(fit), all_allowed),
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
    assert mixed.lost == {short: (2.5,), long: (1.0, 1.95)}
    won = LawfulChoice.of(plain, [law], {short: [2.5], long: [1.0, 1.52]})
    assert won.law is law and won.ratios == pytest.approx([0.5, 0.8])
    assert won.made.chosen == long and set(won.made.errors) == {"short", "long", long}
    assert LawfulChoice.of(plain, [], {}) == LawfulChoice(plain)


def test_values_of_laws_stand_in_the_order_in_which_they_were_taken(
    small_problem: Callable[..., Problem],
) -> None:
    """Two laws with one and two parameters: each finding and each fact has its own values."""
    problem = small_problem()
    K = len(problem.space)
    lag = [Parameter.from_zero("a.lag", "command_lag", (problem.robot.actuator_names[0],), "s", 0.005, 0.1)]
    joint = problem.robot.description.joint_names[:1]
    fall = Parameter.friction_at_rest("a", joint, 0.1)
    start = problem.space.nominal, 0.0
    first = LawCandidate(PLAY_LAW, lag, (0.4, 2.0), start)
    second = LawCandidate(STRIBECK_LAW, fall, (0.4, 2.0), start)
    plain = Choice("long", {"long": (2.0, 2.0)}, 2.0)
    one = LawfulChoice.of(plain, [first], {first.names[1]: [1.0, 1.0]})
    two = LawfulChoice.of(one.made, [second], {second.names[0]: [0.9, 0.9]})
    none = LawfulChoice(two.made, lost={"other": (3.0,)})
    rounds = [(ScreenedLaws(), choice) for choice in (one, two, none)]
    wide = second.widened(first.widened(problem))
    taken = LawsTaken(wide, rounds, start)
    assert taken.made.chosen == second.names[0] and taken.to_json()["lost"] == {"other": [3.0]}
    assert taken.widened(problem).space.names == wide.space.names
    theta = np.arange(K + 3.0)
    facts = taken.facts(theta)
    assert [fact["values"] for fact in facts] == [
        {"a.lag": K},
        {"a.friction_stribeck": K + 1.0, "a.stribeck_speed": K + 2.0},
    ]
    assert [fact["error_ratio"] for fact in facts] == [[0.5, 0.5], [0.9, 0.9]]
    assert "50 % lower" in taken.findings(theta)[0].seen and "10 % lower" in taken.findings(theta)[1].seen


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
    (lags,) = (law.parameters(problem) for law in HYPOTHESES if law.name == "drives that lag")
    assert [(p.elements, p.nominal, p.high) for p in lags] == [
        (("shoulder",), 0.005, 0.1),
        (("elbow",), 0.08, 0.16),
    ]
