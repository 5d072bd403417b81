"""What a residual looks like: causes made by hand in one joint, and faults of simulated robots."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from fakes.knee_evidence import SAMPLES, STD, WINDOWS, knee_evidence, knee_motion, moved_by
from fakes.plain_truth import problem_of, truth

from deal_hw.calib.data.folds import fold_numbers
from deal_hw.calib.data.parts import part_of
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.intervals import uncertainty_at, with_rows
from deal_hw.calib.fit.refinement import Refined, refine
from deal_hw.calib.fit.residual import WindowRows
from deal_hw.calib.hypotheses import diagnosis
from deal_hw.calib.hypotheses.cause_words import Diagnosis, SearchedKinds
from deal_hw.calib.hypotheses.diagnosis import all_allowed, name_causes, unnamed_shift, weighs
from deal_hw.calib.hypotheses.evidence import Evidence, evidence, unsure_shift
from deal_hw.calib.hypotheses.laws import PLAY
from deal_hw.calib.hypotheses.signatures import (
    Cause,
    Signature,
    held_direction,
    masses,
    place_in_play,
    signatures,
)
from deal_hw.calib.hypotheses.thresholds import EVIDENCE, NEAR_CHI2
from deal_hw.calib.hypotheses.trials import Explained, Tried, explained, try_hypotheses
from deal_hw.calib.hypotheses.wider_models import fit_wider, zero_parameters
from deal_hw.calib.validation.checks import biased, unexplained, with_causes, with_unsure
from deal_hw.calib.validation.residual_place import (
    Kind,
    Quantity,
    densest,
    densest_stretch,
    quantities,
    size_over,
)
from deal_hw.calibration import Z90
from deal_hw.findings import Finding
from deal_hw.testing.plain_robots import make_robot
from deal_hw.types import FloatArray


def _named(wrong: FloatArray, columns: tuple[FloatArray, ...] = ()) -> list[Diagnosis]:
    return name_causes(knee_evidence(wrong, columns))


def test_noise_looks_like_nothing() -> None:
    """White residuals have nothing to explain: no cause is named."""
    assert _named(np.zeros((WINDOWS, SAMPLES))) == []


def test_friction_at_low_speed() -> None:
    """A force against the motion that dies out with speed."""
    v, _ = knee_motion()
    found = _named(moved_by(-1.0 * np.sign(v) * np.exp(-np.abs(v) / 0.1)))
    assert found[0].code == "friction" and found[0].subject == ("knee",)
    assert found[0].share > 0.5 and "dof_friction_creep" in found[0].do


def test_sensor_on_the_motors_side_of_the_play() -> None:
    """0.4 mrad of play: an offset with the direction of motion."""
    v, _ = knee_motion()
    found = _named(2e-4 * np.sign(v))
    assert found[0].code == "backlash" and "the gear of knee" in found[0].do
    assert found[0].share > 0.5


def test_damping_that_no_parameter_has() -> None:
    """A force in proportion to velocity, and none left once a parameter does that."""
    v, _ = knee_motion()
    wrong = moved_by(-0.3 * v)
    found = _named(wrong)
    assert found[0].code == "damping" and found[0].share > 0.8
    assert _named(wrong, (wrong,)) == []


def test_a_slow_random_force_is_no_cause() -> None:
    """Neighbouring residuals are alike, so a tenth of them looks like a cause by chance in some windows.

    Counted as independent, they would name one on half of these robots.
    """
    v, _ = knee_motion()
    named = 0
    for seed in range(10):
        force = np.cumsum(np.random.default_rng(seed).normal(scale=0.03, size=v.shape), axis=1)
        named += any(cause.code not in ("contact", "delay") for cause in _named(moved_by(force)))
    assert named <= 1


def test_a_parameter_that_other_windows_hardly_show_makes_no_cause() -> None:
    """All windows fit it, so that no cause gains by undoing what the others made of it."""
    v, _ = knee_motion()
    seen = np.where(fold_numbers(WINDOWS, 4, 2) == 0, 1.0, 0.03)[:, None]
    force = np.cumsum(np.random.default_rng(0).normal(scale=0.03, size=v.shape), axis=1)
    known = knee_evidence(moved_by(force), (moved_by(-v) * seen,))
    fitted = sum(float(np.sum(r**2)) for r in known.residual([]))
    assert known.held_out([]) == pytest.approx(fitted, rel=1e-6)
    # A cause that is the parameter explains nothing where that is seen, and is in the other windows.
    damping = moved_by(-0.3 * v)
    assert [cause.code for cause in name_causes(knee_evidence(damping, (damping * seen,)))] == ["damping"]
    assert name_causes(known) == []


def test_each_cause_weighs_what_it_makes_likely() -> None:
    """Gains of 2 ln 3 and 0 beside none: weights of 3/5 and 1/5, and 1/5 for no shift."""
    found = unsure_shift([2 * np.log(3.0), 0.0], [np.array([2.0, 0.0]), np.array([1.0, 5.0])])
    np.testing.assert_allclose(found, [np.sqrt(0.6 * 4 + 0.2), np.sqrt(0.2 * 25)])


def test_causes_that_may_be_there_move_a_parameter() -> None:
    """A load beside a parameter that pushes 1 + v: with a load it is 0, and with damping of its other part.

    Both explain all, so each weighs 1/2: the load moves it by least squares, the damping by a tenth of that.
    """
    v, _ = knee_motion()
    load, push = (moved_by(force) for force in (np.ones_like(v), 1 + v))

    def seen(known: Evidence, moved: FloatArray) -> FloatArray:
        return known.rows[0].without_starts(np.pad(moved / STD, ((0, 0), (0, 2)))[..., None]).ravel()

    known = knee_evidence(0.02 * load, (push,))
    alone = float(seen(known, 0.02 * load) @ seen(known, push) / np.sum(seen(known, push) ** 2))
    assert unnamed_shift(known, ())[0] == pytest.approx(alone / np.sqrt(2), rel=0.1)
    assert unnamed_shift(known, {"load", "damping"})[0] < 0.1 * alone
    little = knee_evidence(0.004 * load, (push,))
    assert name_causes(little) == [] and unnamed_shift(little, ())[0] > 0.2 * alone / 5


def test_a_parameters_own_effect_is_no_other_cause() -> None:
    """However little the recordings show of it."""
    v, _ = knee_motion()
    known = knee_evidence(np.zeros_like(v), (moved_by(np.ones_like(v)),))
    assert [s.cause for s in known.found if known.distinct(s) is None] == ["load"]
    assert all(known.distinct(s) in (s, None) for s in known.found)


def test_intervals_hold_what_was_unsure(small_problem: Callable[..., Problem]) -> None:
    """Standard deviations of 3 and 4 are one of 5; so are reaches of a latency of 3 ms and 4 ms."""
    problem = small_problem(fixed_latency_s=None)
    fit = with_rows(refine(problem, problem.space.nominal, 0.03, (0.2,), iterations=2))
    K, low = len(problem.space), fit.latency_s - 0.003
    known = dataclasses.replace(
        uncertainty_at(problem, fit).with_covariance(9e-6 * np.eye(K)),
        blind=np.zeros(K, dtype=bool),
        latency_interval_s=(low, fit.latency_s + 0.003),
    )
    wider = with_unsure(problem, fit, known, np.append(np.full(K, 0.004), 0.004 / Z90))
    assert np.sqrt(np.diag(wider.covariance)) == pytest.approx(0.005)
    assert wider.latency_interval_s == pytest.approx((fit.latency_s - 0.005, fit.latency_s + 0.005))
    assert with_unsure(problem, fit, known, np.zeros(0)) is known


@pytest.mark.parametrize(
    ("cause", "force"), [("inertia", lambda a: 0.05 * a), ("load", lambda a: 0.3 + 0 * a)]
)
def test_forces_of_size_and_acceleration(cause: Cause, force: Callable[[FloatArray], FloatArray]) -> None:
    """A constant force is a load, one in proportion to acceleration an inertia."""
    found = _named(moved_by(force(knee_motion()[1])))
    assert found[0].code == cause and found[0].share > 0.8
    assert len(found) == 1


def test_two_causes_are_named_and_the_larger_first() -> None:
    """A load of 0.3 and a damping of a third of its effect."""
    v, _ = knee_motion()
    found = _named(moved_by(np.full_like(v, 0.3)) + moved_by(-0.1 * v))
    assert [f.code for f in found] == ["load", "damping"]
    assert found[0].deviance > found[1].deviance > EVIDENCE


def _with_masses(wrong: FloatArray, **effect: FloatArray) -> Evidence:
    """Return evidence with bodies whose mass has these effects on the prediction, (W, H) of twice it."""
    known = knee_evidence(wrong)
    bodies = [Signature("mass", name, (x[..., None] / STD,)) for name, x in effect.items()]
    return dataclasses.replace(known, found=[*(s for s in known.found if s.cause != "inertia"), *bodies])


def test_no_mass_below_zero_is_named() -> None:
    """A residual as of a cart 1.6 times heavier is also that of a pole 1.6 times lighter: impossible."""
    v, _ = knee_motion()
    effect = moved_by(v * np.abs(v) + 0.3)
    found = name_causes(_with_masses(-1.6 * effect, cart=effect, pole=-effect))
    assert found[0].code == "mass" and found[0].subject == ("cart",)
    assert "cart 160 % heavier" in found[0].seen and "pole" not in found[0].seen
    assert not any(f.code == "mass" for f in name_causes(_with_masses(-1.6 * effect, pole=-effect)))


def test_a_rotor_is_named_beside_the_mass_that_moves_alike() -> None:
    """A force with acceleration at a slide is as much a heavier cart: both stand in one alarm."""
    _, a = knee_motion()
    effect = moved_by(0.05 * a)
    known = _with_masses(effect, cart=-effect)
    rotor = Signature("inertia", "slide", ((effect + moved_by(0.002 + 0 * a))[..., None] / STD,))
    (found,) = name_causes(dataclasses.replace(known, found=[*known.found, rotor]))[:1]
    assert found.code == "mass" and "cart 100 % heavier" in found.seen
    assert "another inertia at slide explains as much" in found.seen
    assert "free dof_armature of slide" in found.do


def test_advice_frees_only_what_is_not_free() -> None:
    """Damping that is searched follows another law; at its bound the range is too narrow."""
    v, _ = knee_motion()
    known = knee_evidence(moved_by(-0.3 * v))
    free = frozenset({("dof_damping", "knee"), ("servo_damping", "knee")})
    searched = dataclasses.replace(known, searched=SearchedKinds(free))
    assert "searched already" in name_causes(searched)[0].do
    half = dataclasses.replace(known, searched=SearchedKinds(frozenset({("dof_damping", "knee")})))
    assert name_causes(half)[0].do == "Free servo_damping of knee (--parameters)."
    ended = SearchedKinds(free, (("knee.damping", "dof_damping", "knee"),))
    alarm = name_causes(dataclasses.replace(known, searched=ended))[0]
    assert "knee.damping ended at the bound" in alarm.means and "--range" in alarm.do


def test_a_value_that_compensates_for_a_cause_is_marked(small_problem: Callable[..., Problem]) -> None:
    """What takes part of a load moves once the load is named: that widens its interval, and marks it."""
    v, _ = knee_motion()
    load = moved_by(np.full_like(v, 0.3))
    (found,) = _named(load + moved_by(-0.1 * v), (0.5 * load + moved_by(0.2 * v),))[:1]
    assert abs(found.shift[0]) > 0.1
    problem = small_problem()
    fit = with_rows(refine(problem, problem.space.nominal, 0.0, (0.2,), iterations=2))
    known = uncertainty_at(problem, fit)
    std = np.sqrt(np.diag(known.covariance))
    shift = np.array([2 * std[0], 0.1 * std[1], 0.0])
    wider = biased(problem, known, [dataclasses.replace(found, code="load", shift=shift)])
    names = problem.space.names
    assert wider.biased == {names[0]: "load"} and "identifiable" != wider.verdicts[0] != known.verdicts[0]
    (low, high), center = problem.space.to_scale(wider.interval.T), problem.space.to_scale(known.theta)
    assert np.all(low <= center - np.abs(shift[:2])) and np.all(high >= center + np.abs(shift[:2]))
    assert biased(problem, known, ()) is known


def test_contact_comes_in_bursts() -> None:
    """Two stretches of 60 ms with an error of 20 standard deviations, at 1.0 and 3.2 s."""
    wrong = np.zeros((WINDOWS, SAMPLES))
    rng = np.random.default_rng(2)
    for window, sample in ((2, 40), (8, 0)):
        wrong[window, sample : sample + 12] = 20 * STD * rng.normal(size=12)
    found = {f.code: f for f in _named(wrong)}
    assert "contact" in found
    assert "rec.csv 0.98 to 1.07 s, rec.csv 3.18 to 3.28 s" in found["contact"].do
    # Far above the noise they are a part of what the model lacks.
    assert not [f for f in name_causes(knee_evidence(wrong), 1000.0) if f.code == "contact"]


def test_a_joint_without_a_drive_has_no_gear(small_problem: Callable[..., Problem]) -> None:
    """Play was named at the pole of a cart, which swings freely."""
    problem = small_problem()
    fit = with_rows(refine(problem, problem.space.nominal, 0.0, (0.2,), iterations=1))
    geared = {s.where for s in signatures(problem, fit) if s.cause in ("backlash", "lag")}
    assert geared == {"cart"}


def test_from_a_fit_far_from_the_noise_no_signature_is_named() -> None:
    """A load that explains nearly all is one near the noise; far from it the fit is not the robot."""
    known = knee_evidence(moved_by(np.full((WINDOWS, SAMPLES), 0.3)))
    assert [f.code for f in name_causes(known, NEAR_CHI2)] == ["load"]
    assert name_causes(known, 1.01 * NEAR_CHI2) == []


@pytest.mark.parametrize(("after", "named"), [(NEAR_CHI2, True), (1.01 * NEAR_CHI2, False)])
def test_a_law_is_named_from_the_fit_that_has_it(
    after: float,
    named: bool,
    noisy_problem: Problem,
    noisy_refined: Refined,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Around a fit with a chi2 of 100 a law that leaves 9 is a cause, and one that leaves more is none."""
    poor = with_rows(dataclasses.replace(noisy_refined, chi2=100.0))
    alarm = Finding.alarm("With play it is better.", "It is play.", "Repair it.")
    cause = Diagnosis.of("backlash", 1 - after / 100, 900.0, ("cart",), alarm)
    law = Explained(PLAY, cause, noisy_problem, poor.theta, 0.0, after, 100.0)
    monkeypatch.setattr(diagnosis, "explained", lambda *_: [law])
    monkeypatch.setattr(diagnosis, "name_causes", lambda *_: [])
    tried = [Tried(PLAY, noisy_problem, 0.0, None)]
    assert diagnosis.diagnose(noisy_problem, poor, tried).causes == ((cause,) if named else ())


def test_a_residual_without_a_cause_is_placed(small_problem: Callable[..., Problem]) -> None:
    """A sensor is wrong in a part of the travel: the alarm names these positions, and no cause."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-3.0, 3.0, 20_000)
    power = rng.normal(size=20_000) ** 2 * np.where((position > 0.9) & (position < 1.2), 60.0, 1.0)
    found = densest_stretch(power, position)
    # Bins of 6/16: the stretch reaches from 0.75 to 1.5 at most.
    assert found is not None and 0.7 < found.low < 0.9 and 1.1 < found.high < 1.51
    assert found.share == pytest.approx(0.05 * 60 / (0.05 * 60 + 0.95), abs=0.05)
    assert densest_stretch(rng.normal(size=20_000) ** 2, position) is None
    assert densest_stretch(np.ones(5), np.ones(5)) is None

    problem = small_problem()
    fit = with_rows(refine(problem, problem.space.nominal, 0.0, (0.2,), iterations=2))
    (data,), (residual,) = fit.shooting.data, fit.normal.residual
    cart = problem.measured(data.episode)[data.windows.samples()][..., 0]
    blind = cart > np.quantile(cart, 0.95)
    wrong = np.zeros_like(residual)
    wrong[..., 0] = np.where(blind, 50.0, 1.0)
    fit = dataclasses.replace(fit, chi2=100.0, normal=dataclasses.replace(fit.normal, residual=(wrong,)))
    known, causes = with_causes(problem, fit, uncertainty_at(problem, fit), ())
    assert causes == []
    seen = known.alarms[0].seen
    assert "10.0 times" in seen and "too far to name a cause: the limit is 3 times the noise" in seen
    near = with_causes(problem, dataclasses.replace(fit, chi2=4.0), uncertainty_at(problem, fit), ())[0]
    assert "None of the known causes explains them." in near.alarms[0].seen
    assert "where cart is between" in seen and f"and {cart.max():.2f} m" in seen
    assert "100 % of its square is in cart" in seen


def test_what_a_residual_may_depend_on(small_problem: Callable[..., Problem]) -> None:
    """Position, speed and load of each joint, the command of those with a motor, and the time."""
    problem = small_problem()
    found = {(one.kind, one.of): one for one in quantities(problem, 0.0)}
    assert set(found) == {
        *((kind, joint) for kind in ("position", "speed", "load") for joint in ("cart", "pole")),
        ("command", "cart"),
        ("time", problem.episodes[0].name),
    }
    assert [found[kind, "pole"].unit for kind in ("position", "speed", "load")] == ["rad", "rad/s", "N·m"]
    (command,), (episode,) = found["command", "cart"].values, problem.episodes
    late = {one.kind: one for one in quantities(problem, 30 * episode.step_s)}["command"].values[0]
    assert len(command) == len(episode.sample) and not np.array_equal(command, late)
    assert command[-1] == episode.target[episode.sample[-1] - 1, 0]
    assert late[-1] == episode.target[episode.sample[-1] - 31, 0]


def test_a_residual_is_placed_by_what_it_depends_on() -> None:
    """At large speeds either way, in one direction, or once; of two that are alike the position."""
    rng = np.random.default_rng(0)
    n = 20_000
    position, speed = rng.uniform(-1.0, 1.0, n), rng.normal(0.0, 1.0, n)
    time = np.linspace(0.0, 20.0, n)
    named: list[tuple[Kind, str, str, FloatArray]] = [
        ("time", "swing.csv", "s", time),
        ("speed", "elbow", "rad/s", speed),
        ("position", "elbow", "rad", position),
    ]
    over = [(Quantity(kind, of, unit, ()), values) for kind, of, unit, values in named]

    def place(there: npt.NDArray[np.bool_]) -> str:
        found = densest(np.where(there, 400.0, 1.0), over)
        assert found is not None and found[0].density > 2.5
        return found[1]

    assert place(np.abs(speed) > 2.2).startswith("where the speed of elbow is between 2.")
    assert place(np.abs(speed) > 2.2).endswith("rad/s, either way")
    assert "either way" not in place(speed < -2.0)
    assert place((time > 5.0) & (time < 5.5)).endswith("s of swing.csv")
    alike = [(over[1][0], position), (over[2][0], position)]
    found = densest(np.where(position > 0.95, 400.0, 1.0), alike)
    assert found is not None and found[1].startswith("where elbow is between")
    assert densest(np.ones(n), over) is None


def test_the_size_of_a_residual_over_a_quantity() -> None:
    """By hand: 3 in the lower half of the range, 1 in the upper one; too few samples are no value."""
    values = np.concatenate([np.linspace(0.0, 1.0, 320, endpoint=False), [2.0]])
    middle, size = size_over(np.where(values < 0.5, 9.0, 1.0), values)
    # Parts are 1/8 wide: 40 samples in each up to 1, none beyond, and one in the last.
    assert middle[:2] == pytest.approx([0.0625, 0.1875])
    assert size[:8] == pytest.approx([3.0] * 4 + [1.0] * 4)
    assert np.isnan(size[8:]).all()
    assert all(len(part) == 0 for part in size_over(np.ones(50), np.ones(50)))
    missing = np.where(np.arange(len(values)) % 2, np.nan, 4.0)
    assert size_over(missing, values)[1][0] == pytest.approx(2.0)


def _with_gaps(known: Evidence, share: float) -> Evidence:
    """Return evidence of a recording with a share of its samples lost: their rows are 0."""
    (rows,) = known.rows
    lost = np.random.default_rng(1).random((WINDOWS, SAMPLES)) < share
    kept = np.concatenate([~lost, np.ones((WINDOWS, 2), dtype=bool)], axis=1)
    return dataclasses.replace(
        known,
        rows=[
            WindowRows(rows.residual * kept, rows.parameter * kept[..., None], rows.start * kept[..., None])
        ],
        found=[
            dataclasses.replace(s, columns=tuple(x * kept[:, :SAMPLES, None] for x in s.columns))
            for s in known.found
        ],
    )


def test_lost_samples_are_no_quiet_ones_between_bursts() -> None:
    """White noise in a third of the samples, the others lost, touches nothing."""
    assert name_causes(_with_gaps(knee_evidence(np.zeros((WINDOWS, SAMPLES))), 0.7)) == []


def test_lost_samples_are_no_evidence() -> None:
    """With 40 % of the samples lost, a load gains about 60 % of the deviance of all samples."""
    known = knee_evidence(moved_by(np.full((WINDOWS, SAMPLES), 0.3)))
    whole, part = (name_causes(k)[0] for k in (known, _with_gaps(known, 0.4)))
    assert part.code == whole.code == "load"
    assert part.deviance == pytest.approx(0.6 * whole.deviance, rel=0.15)


def test_direction_is_kept_where_a_joint_is_still() -> None:
    """0.5, 0.0001, -0.0001, -0.5, 0.0001 with 0.001 as still: up, up, up, down, down."""
    v = np.array([[0.5, 1e-4, -1e-4, -0.5, 1e-4]])
    assert held_direction(v, 1.0).ravel() == pytest.approx([1, 1, 1, -1, -1])


@pytest.mark.parametrize("windows", range(4, 12))
def test_no_fold_leaves_out_nothing(windows: int) -> None:
    """A recording of 4 s has four or five windows: each fold leaves out at least one."""
    assert set(fold_numbers(windows, 4, 2)) == set(range(4))


def test_every_window_is_left_out_once_in_stretches() -> None:
    """16 windows in four folds, each of two stretches of two."""
    assert fold_numbers(16, 4, 2).tolist() == [0, 0, 1, 1, 2, 2, 3, 3] * 2


@pytest.mark.slow
def test_a_right_model_has_no_cause() -> None:
    """Neither a signature, nor a delay, nor play predicts left-out windows better."""
    _, problem, fit = truth("pendulum", None)
    assert name_causes(evidence(problem, fit)) == []
    assert explained(problem, fit, try_hypotheses(problem, fit, all_allowed)) == []


@pytest.mark.slow
def test_faults_of_a_simulated_robot_are_named() -> None:
    """Stribeck friction, and commands that are late by up to twice the mean delay.

    If no delay may be so long, delays are not the cause.
    """
    _, problem, fit = truth("pendulum", "friction")
    friction = name_causes(evidence(problem, fit))
    assert friction[0].code == "friction" and friction[0].subject == ("pivot",)
    _, problem, fit = truth("pendulum", "jitter")
    known = evidence(problem, fit)
    assert known.most_delay_std_s == problem.latency_range_s[1] / 2
    jitter = name_causes(known)
    assert jitter[0].code == "delay" and "its own delay" in jitter[0].seen
    short = dataclasses.replace(known, most_delay_std_s=1e-4)
    assert "delay" not in [one.code for one in name_causes(short)]


def test_a_link_crosses_its_play_as_a_free_body() -> None:
    """Half of 0.02 rad ahead, 2 rad/s^2: 0.02 = 2 t^2 / 2 takes 0.141 s to the other stop, where it stays.

    A load that turns round brings it back in the same time.
    """
    needed = np.repeat([2.0, -2.0], 1000)
    place = place_in_play(needed, 1e-3, 0.02)
    assert place[0] == pytest.approx(0.01, abs=1e-5) and place[999] == -0.01
    first, back = np.flatnonzero(place == -0.01)[0], 1000 + np.flatnonzero(place[1000:] == 0.01)[0]
    assert first == pytest.approx(141, abs=2) and back == pytest.approx(1141, abs=2)
    # On its way, half of the time is a quarter of the path.
    assert place[70] == pytest.approx(0.01 - 0.02 / 4, abs=3e-4)


@pytest.mark.slow
def test_play_behind_the_motors_encoder_is_named() -> None:
    """1 degree in the elbow, which no set-point's play explains: backlash there, not a heavier link."""
    _, problem, fit = truth("double-pendulum", "motor-play")
    found = name_causes(evidence(problem, fit))
    assert found[0].code == "backlash" and found[0].subject == ("elbow",)
    assert "servo_play" in found[0].do and "on either side" in found[0].means
    assert not any(f.code == "mass" for f in found)


@pytest.mark.slow
def test_a_mass_is_named_with_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last link weighs 50 % more."""
    _, problem, fit = truth("double-pendulum", "mass")
    found = name_causes(evidence(problem, fit))
    assert found[0].code == "mass" and "fore" in found[0].subject
    assert "Weigh" in found[0].do and "heavier" in found[0].seen
    known = uncertainty_at(problem, fit, fixed_latency=False)
    assert known.alarms and with_causes(problem, fit, known, found)[0].alarms[0] == found[0]
    # The signature is linear. A model with the mass must predict better, too, and keep some of it.
    wide = fit_wider(problem, [p for p in masses(problem) if p.elements[0] == "fore"])
    assert wide is not None and wide.found[0] == pytest.approx(1.5 * wide.more[0].nominal, rel=0.2)

    def said(share: float) -> bool:
        theta = np.append(wide.fit.theta[:-1], share * wide.more[0].nominal)
        found_at = dataclasses.replace(wide, fit=dataclasses.replace(wide.fit, theta=theta))
        monkeypatch.setattr(diagnosis, "fit_wider", lambda *_: found_at)
        return weighs(problem, fit, found[0], (), all_allowed)

    assert said(1.5) and not said(0.2)
    monkeypatch.setattr(diagnosis, "held_out", lambda *_: None)
    assert not said(1.5)


def test_half_of_two_recordings_is_a_part(small_problem: Callable[..., Problem]) -> None:
    """Of 1 s and 1.11 s, whose sum over its half is 1.9999999999999996, the rest is left to predict."""
    whole = small_problem()
    ends = (slice(200), slice(222))
    names = ("sample", "position", "velocity", "usable")
    (episode,) = whole.episodes
    parts = [dataclasses.replace(episode, **{n: getattr(episode, n)[end] for n in names}) for end in ends]
    problem = whole.on(parts, None)
    total_s = sum(len(e.sample) * e.period_s for e in problem.episodes)
    left_out = [~e.usable for e in part_of(problem, total_s / 2).episodes]
    assert sum(map(np.count_nonzero, left_out)) >= 200


@pytest.mark.slow
def test_an_armature_that_is_0_in_the_model_is_named_with_its_value(tmp_path: Path) -> None:
    """A rotor of 0.01 kg m^2 behind a pendulum of 0.0075; the model has none, so nothing searches it."""
    robot = make_robot("pendulum", 3)
    without, rotor = (
        re.sub('armature="[^"]*"', f'armature="{value}"', text)
        for text, value in ((robot.model, 0), (robot.robot, 0.01))
    )
    problem = problem_of(dataclasses.replace(robot, model=without, robot=rotor), tmp_path)
    fit = with_rows(refine(problem, problem.space.nominal, robot.delay_s, (0.2,), iterations=8))
    assert "pivot.armature" not in problem.space.names and unexplained(fit)
    assert [p.name for p in zero_parameters(problem)] == ["pivot.armature"]
    tried = try_hypotheses(problem, fit, all_allowed)
    best = explained(problem, fit, tried)[0]
    found = best.diagnosis
    assert best.hypothesis.name == "a rotor's inertia that is 0 in the model" and best.explains
    value = float(re.findall(r"pivot.armature = (\S+) kg", found.seen)[0])
    assert value == pytest.approx(0.01, rel=0.1)
    assert found.code == "inertia" and found.subject == ("pivot",) and found.share > 0.5
    assert "was not searched" in found.means and "MJCF" in found.do
    # The others made up for it.
    assert np.abs(found.shift[:-1]).max() > 0.1
