"""Fisher information of an excitation: against a linear case solved by hand, and the search for the best."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.linalg import inv

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.design.advice import advise, menu_designs, next_step, predict_menu
from deal_hw.calib.design.closed_loop import Scenario, TrialRunner
from deal_hw.calib.design.excitation_search import SearchSettings, score, search_excitation
from deal_hw.calib.design.experiment_design import (
    ExpectedInformation,
    Experiment,
    MakeBehaviour,
    Prior,
    information,
)
from deal_hw.calib.fit.residual import Shooting
from deal_hw.calibration import LATENCY_RANGE_S, CalibrationResult, Identifiability
from deal_hw.description import LegLimits, RobotDescription, SafetyLimits, SensorModel
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.cartpole.description import k9_space
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.errors import CalibrationError, ConfigurationError
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig
from deal_hw.motions.excitation.plan import ExcitationBehaviour, ExcitationDesign, make_plan
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.types import FloatArray

MASS, DAMPING, STIFFNESS, GAIN = 2.0, 3.0, 150.0, 12.0
NOISE = 1e-3
MJCF = f"""
<mujoco>
  <compiler autolimits="true"/>
  <option timestep="0.001" integrator="Euler" gravity="0 0 0"/>
  <worldbody><body name="slide">
    <inertial pos="0 0 0" mass="{MASS}" diaginertia="1e-3 1e-3 1e-3"/>
    <joint name="slide" type="slide" axis="1 0 0" damping="{DAMPING}"/>
  </body></worldbody>
  <actuator>ACTUATOR</actuator>
</mujoco>
"""
POSITION = f'<position name="slide" joint="slide" kp="{STIFFNESS}" kv="{GAIN}" forcerange="-60 60"/>'


def ranges(parameters: ParameterSpace) -> ParameterDistribution:
    """Return what is known before any calibration."""
    return ParameterDistribution.uniform(parameters, LATENCY_RANGE_S)


def describe(folder: Path, actuation: str) -> RobotDescription:
    """Return a mass on a damper, driven by a motor of 1 N or by a position servo."""
    servo = actuation == "position"
    path = folder / f"{actuation}.xml"
    motor = '<motor name="slide" joint="slide" gear="1" ctrlrange="-1 1"/>'
    path.write_text(MJCF.replace("ACTUATOR", POSITION if servo else motor))
    return RobotDescription(
        name="slide",
        joint_names=("slide",),
        actuated=("slide",),
        position_units=("m",),
        default_position=(0.0,),
        stiffness=(STIFFNESS if servo else 0.0,),
        damping=(GAIN if servo else 0.0,),
        effort_limit=(60.0 if servo else 1.0,),
        speed_limit=(math.inf,),
        control_rate_hz=50.0,
        device_rate_hz=1000.0,
        state_rate_hz=200.0,
        limits=SafetyLimits(
            target=((-0.5, 0.5) if servo else (-1.0, 1.0),),
            target_step=(2.0,),
            target_distance=(5.0,),
            trip_position=((-3.0, 3.0),),
            trip_velocity=(20.0,),
            stiffness=(200.0,),
            damping=(20.0,),
            effort=(60.0,),
            speed=(math.inf,),
            state_age_s=0.1,
            action_age_s=0.1,
            ease_in_s=0.0,
        ),
        sensor=SensorModel(noise=(NOISE,), resolution=(0.0,), velocity_window_s=0.0),
        mjcf=path,
        actuation=actuation,
    )


def space(*names: str) -> ParameterSpace:
    """Return the named parameters of the slide."""
    table = {
        "mass": ("body_mass", "kg", MASS),
        "damping": ("dof_damping", "N·s/m", DAMPING),
        "armature": ("dof_armature", "kg", 1e-2),
        "effort_limit": ("servo_effort_limit", "N", 60.0),
    }
    return ParameterSpace(
        Parameter.around(f"slide.{n}", table[n][0], ["slide"], table[n][1], table[n][2]) for n in names
    )


@pytest.fixture(scope="module")
def motor(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    """The mass on a damper with a motor."""
    return load_model(describe(tmp_path_factory.mktemp("motor"), "motor"))


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    """The mass on a damper with a position servo."""
    return load_model(describe(tmp_path_factory.mktemp("servo"), "position"))


def exact_window(mass: float, damping: float, start: FloatArray, force: FloatArray) -> FloatArray:
    """Return positions after each 5 ms of m a = F - d v, solved exactly over steps of 1 ms."""
    h, tau = 1e-3, mass / damping
    decay = math.exp(-h / tau)
    x, v = start
    out = []
    for i, f in enumerate(force, start=1):
        steady = f / damping
        x, v = x + steady * h + (v - steady) * tau * (1 - decay), steady + (v - steady) * decay
        if i % 5 == 0:
            out.append(x)
    return np.array(out)


def test_information_of_a_mass_on_a_damper(motor: RobotModel) -> None:
    """As from the exact solution: derivatives by ln m and ln d, start states eliminated by Schur complement.

    Two windows of 0.8 s with unknown starts; a start position is known to the sensor's 1 mm, a velocity to
    3 m/s. The engine's Euler steps of 1 ms differ from the exact solution by about 1 / 1000.
    """
    parameters = space("mass", "damping")
    scenario = Scenario(parameters.nominal[None], np.zeros(1), np.zeros((1, 1)))
    plan = make_plan(motor.description, ExcitationDesign(seconds=1.62, high_hz=3.0, low_hz=1.0, seed=2))
    (trial,) = TrialRunner(motor, parameters, scenario, 1.62, 1).run(
        [ExcitationBehaviour(plan, motor.description)]
    )
    assert not trial.tripped and not trial.clipped
    states = [(trial.episode.position, trial.episode.velocity)]
    found = information(
        motor, parameters, [trial.episode], parameters.nominal, 0.0, threads=1, states=states
    )[:2, :2]

    episode, expected = trial.episode, np.zeros((2, 2))
    point = np.log([MASS, DAMPING])
    for begin in (0, 160):
        force = episode.target[5 * begin : 5 * (begin + 160), 0]
        start = np.array([episode.position[begin, 0], episode.velocity[begin, 0]])
        unknowns = np.concatenate([point, start])

        def path(u: FloatArray, force: FloatArray = force) -> FloatArray:
            return exact_window(math.exp(u[0]), math.exp(u[1]), u[2:], force)

        step = 1e-4
        J = np.stack(
            [(path(unknowns + e) - path(unknowns - e)) / (2 * step) for e in step * np.eye(4)], axis=1
        )
        F = J.T @ J / NOISE**2
        F[2, 2] += 1 / NOISE**2
        F[3, 3] += 1 / 3.0**2
        expected += F[:2, :2] - F[:2, 2:] @ inv(F[2:, 2:]) @ F[2:, :2]
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_posterior_and_gain_by_hand() -> None:
    """Range ln 25 wide: prior variance (ln 25)^2 / 12 = 0.8634. Information 100: 1 / (1.1582 + 100)."""
    parameters = space("mass")
    prior = Prior.of(ranges(parameters))
    hessian = np.diag([100.0, 0.0])
    covariance = prior.posterior(hessian)
    assert covariance[0, 0] == pytest.approx(1 / (1 / 0.86344 + 100.0), rel=1e-4)
    assert prior.gain(covariance) == pytest.approx(0.5 * math.log(0.86344 * (1 / 0.86344 + 100.0)), rel=1e-4)
    assert prior.gain(prior.posterior(np.zeros((2, 2)))) == pytest.approx(0.0, abs=1e-9)


def test_null_direction_adds_no_gain(servo: RobotModel) -> None:
    """Mass and armature of a slide are one: freeing both tells nothing about their ratio, and no infinity."""
    plan = make_plan(servo.description, ExcitationDesign(seconds=1.0, low_hz=1.0))
    one, both = (
        Experiment(servo, ranges(space(*names)), 1.0, 1, np.random.default_rng(0), threads=1)
        for names in (("mass",), ("mass", "armature"))
    )
    play = lambda: ExcitationBehaviour(plan, servo.description)  # noqa: E731
    alone, mixed = one.predict(play), both.predict(play)
    assert alone.std[0] < 0.01
    assert np.isfinite(mixed.gain)
    assert mixed.std[1] > 0.5 * space("armature").width[0] / math.sqrt(12)


def test_trial_is_what_the_calibration_would_replay() -> None:
    """With slew, segments and a latency of 9.4 ms the shooting's residual at the trial's truth is nothing."""
    robot, parameters = load_model(CARTPOLE), k9_space()
    behaviours = [RichBehaviour(CARTPOLE, None, RichConfig(duration_s=1.6, balance_s=0.0), 3)]
    scenario = Scenario(parameters.nominal[None] * 1.2, np.array([9.4e-3]), np.array([[0.0, 0.02]]))
    (trial,) = TrialRunner(robot, parameters, scenario, 1.6, 1).run(behaviours)
    std = np.concatenate([CARTPOLE.sensor.position_std, np.ones(2)])
    problem = Problem(robot, parameters, [trial.episode], threads=1, known_std=std)
    shooting = Shooting(problem, 40)
    states = [(trial.episode.position, trial.episode.velocity)]
    normal = shooting.normal(shooting.start(scenario.theta[0], 9.4e-3, states))
    assert normal.count > 200
    assert np.max(np.abs(normal.residual[0])) < 1e-6


def recording(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> list[MakeBehaviour]:
    """Return a list that grows by every behaviour that is tried."""
    seen: list[MakeBehaviour] = []
    plain = experiment.predict

    def predict(
        make: MakeBehaviour, bar: Callable[[ExpectedInformation], bool] | None = None
    ) -> ExpectedInformation:
        seen.append(make)
        return plain(make, bar)

    monkeypatch.setattr(experiment, "predict", predict)
    return seen


@pytest.mark.parametrize("criterion", ["determinant", pytest.param("mean", marks=pytest.mark.slow)])
def test_optimum_is_at_least_as_good_as_all_candidates(
    servo: RobotModel, monkeypatch: pytest.MonkeyPatch, criterion: str
) -> None:
    """Of everything that was tried on all members; and its plan carries the figures."""
    rng = np.random.default_rng(5)
    experiment = Experiment(servo, ranges(space("mass", "damping", "effort_limit")), 1.0, 2, rng, threads=1)
    seen = recording(experiment, monkeypatch)
    settings = SearchSettings(candidates=4, finalists=2, rounds=4, criterion=criterion)  # type: ignore[arg-type]
    plain = make_plan(servo.description, ExcitationDesign(seconds=1.0, low_hz=1.0))
    found = search_excitation(
        experiment, rng, settings, references={"plain": lambda: ExcitationBehaviour(plain, servo.description)}
    )
    assert len(seen) == found.tried + 1 == 3 + 4 + 4 + 1
    # Nothing that was given up on the way would have been better.
    every = [experiment.predict(make) for make in list(seen)[:-1]]
    assert score(found.prediction, settings) == pytest.approx(max(score(p, settings) for p in every))
    assert found.references["plain"].usable
    assert list(found.trace) == sorted(found.trace) and len(found.trace) == 1 + 4
    np.testing.assert_allclose(list(found.plan.predicted.values()), found.prediction.std)
    again = experiment.predict(lambda: ExcitationBehaviour(found.plan, servo.description))
    assert again.gain == pytest.approx(found.prediction.gain)


def test_candidates_that_trip_are_discarded_and_counted(servo: RobotModel) -> None:
    """A robot that trips at 10 mm: the error says how many, and why."""
    limits = dataclasses.replace(servo.description.limits, trip_position=((-0.01, 0.01),))
    tight = dataclasses.replace(servo, description=dataclasses.replace(servo.description, limits=limits))
    experiment = Experiment(tight, ranges(space("mass")), 1.0, 1, np.random.default_rng(0), threads=1)
    with pytest.raises(
        CalibrationError, match=r"none of 6 excitations keeps 'slide'.*slide came near the end"
    ):
        search_excitation(experiment, np.random.default_rng(0), SearchSettings(candidates=3))


def test_a_trial_whose_gains_the_filter_lowers_is_discarded(servo: RobotModel) -> None:
    """12 N·s/m would brake a slide that is faster than 0.04 m/s with more than the 0.5 N allowed."""
    legs = LegLimits(
        effort=(0.5,),
        tilt=1.0,
        tumble=6.0,
        free_fall=2.0,
        free_fall_s=0.1,
        flail_velocity=(9.0,),
        flail_s=0.1,
        temperature=80.0,
        lost_rate=20.0,
        battery=0.2,
        battery_low=0.1,
        voltage=25.0,
        command_age_s=0.1,
    )
    limits = dataclasses.replace(servo.description.limits, legs=legs)
    legged = dataclasses.replace(servo, description=dataclasses.replace(servo.description, limits=limits))
    plan = make_plan(legged.description, ExcitationDesign(seconds=1.0, low_hz=1.0))
    scenario = Scenario(np.array([[MASS], [0.5 * MASS]]), np.zeros(2), np.zeros((2, 1)))
    trials = TrialRunner(legged, space("mass"), scenario, 1.0, 1).run(
        [ExcitationBehaviour(plan, legged.description) for _ in range(2)]
    )
    why = "a joint moved so fast that its braking would exceed the limit of effort"
    assert [trial.tripped for trial in trials] == [why, why]


def test_robots_that_cannot_be_designed_for_are_refused(servo: RobotModel) -> None:
    """A floating base; draws none of which keeps the limits at rest."""
    scenario = Scenario(np.zeros((1, 0)), np.zeros(1), np.zeros((1, 12)))
    with pytest.raises(ConfigurationError, match="floating base"):
        TrialRunner(load_model(GO2), ParameterSpace([]), scenario, 1.0)
    limits = dataclasses.replace(servo.description.limits, trip_velocity=(1e-6,))
    still = dataclasses.replace(servo, description=dataclasses.replace(servo.description, limits=limits))
    plan = make_plan(servo.description, ExcitationDesign(seconds=1.0, low_hz=1.0))
    moving = dataclasses.replace(plan, digest=still.description.digest())
    with pytest.raises(CalibrationError, match="only 0 of 16 draws"):
        Experiment(
            still,
            ranges(space("mass")),
            1.0,
            2,
            np.random.default_rng(0),
            rest=lambda: ExcitationBehaviour(moving, still.description),
            threads=1,
        )


def result(parameters: ParameterSpace, std: FloatArray) -> CalibrationResult:
    """Return a calibration that ended at the nominal values with these standard deviations."""
    value = parameters.to_scale(parameters.nominal)
    interval = np.stack([parameters.from_scale(value + s * 1.645 * std) for s in (-1.0, 1.0)], axis=1)
    verdicts: tuple[Identifiability, ...] = tuple("identifiable" if s < 0.15 else "weak" for s in std)
    return CalibrationResult(
        method="x",
        space=parameters,
        estimate=parameters.nominal,
        interval=interval,
        covariance=np.diag(std**2),
        verdicts=verdicts,
        latency_s=2e-3,
        latency_interval_s=(1e-3, 3e-3),
    )


def seen(*std: float) -> FloatArray:
    """Return the information of recordings that leave these standard deviations, and 1 ms of latency."""
    return np.diag([*(s**-2.0 for s in std), 1e6])


def prior(parameters: ParameterSpace, recorded: FloatArray) -> Prior:
    """Return this information and that of the ranges."""
    return Prior(recorded + np.diag([*(12 / parameters.width**2), 12 / 2e-3**2]))


def test_advice_names_what_lowers_the_spread_most(servo: RobotModel) -> None:
    """An effort limit that was never reached needs a recording that reaches it; nothing else is advised."""
    parameters = space("mass", "damping", "effort_limit")
    found = result(parameters, np.array([0.02, 0.05, 0.6]))
    (advice,) = advise(servo, found, seen(0.02, 0.05, 2.0), seconds=1.6, threads=1)
    assert advice.parameter == "slide.effort_limit"
    assert advice.after < 0.1 * advice.before
    printed = f"record {advice.excitation}: slide.effort_limit goes from 60 % to {100 * advice.after:.2g} %"
    assert advice.sentence == printed


def test_an_interval_that_model_error_widened_shrinks_as_if_it_were_noise(servo: RobotModel) -> None:
    """What the model lacks will be in the next recording, too: the promise is a factor on the interval."""
    parameters = space("mass", "damping", "effort_limit")
    designs = menu_designs(servo.description, seconds=1.6)
    menu = {name: make_plan(servo.description, design) for name, design in designs.items()}
    recorded = seen(0.02, 0.3, 0.1)
    found = result(parameters, np.array([0.02, 0.3, 0.6]))
    advice = {one.parameter: one for one in advise(servo, found, recorded, seconds=1.6, threads=1)}
    before = prior(parameters, recorded)
    alone = predict_menu(servo, found.distribution(), menu, before, threads=1)
    assert sum(p.std[2] > 0.05 for p in alone.values()) > 1
    for k, name in enumerate(parameters.names):
        if name in advice:
            factor = min(p.std[k] for p in alone.values() if p.usable) / np.sqrt(
                inv(before.information)[k, k]
            )
            assert advice[name].after == pytest.approx(factor * advice[name].before)
            assert factor < 0.7
    assert set(advice) == {"slide.damping", "slide.effort_limit"}


def test_what_predicts_alike_stays_whatever_is_recorded(servo: RobotModel) -> None:
    """Two masses explain as much, 50 % apart: a promise keeps that part, and is none where it is most."""
    parameters = space("mass", "damping", "effort_limit")
    alike = {"slide.mass": 0.0, "slide.damping": 0.5, "slide.effort_limit": 0.2}
    found = result(parameters, np.array([0.02, 0.51, 0.6]))
    told = dataclasses.replace(found, provenance={"alike_std": alike})
    recorded = seen(0.02, 0.1, 2.0)
    plain, kept = (
        {one.parameter: one for one in advise(servo, of, recorded, seconds=1.6, threads=1)}
        for of in (found, told)
    )
    limit = kept["slide.effort_limit"]
    own = plain["slide.effort_limit"].after / 0.6 * np.sqrt(0.6**2 - 0.2**2)
    assert limit.after == pytest.approx(np.hypot(own, 0.2), rel=1e-3) and limit.excitation
    assert plain["slide.damping"].excitation and not kept["slide.damping"].excitation
    assert "measure it by other means" in kept["slide.damping"].sentence


def test_advice_says_where_no_excitation_helps(servo: RobotModel) -> None:
    """No motion separates mass and armature of one slide; a calibrated robot needs nothing."""
    parameters = space("mass", "armature")
    open_ = result(parameters, np.array([0.6, 0.7]))
    advice = {a.parameter: a for a in advise(servo, open_, seen(9.0, 9.0), seconds=1.6, threads=1)}
    assert advice["slide.armature"].excitation == ""
    assert "measure it by other means" in advice["slide.armature"].sentence
    rows = [one.to_json() for one in advice.values()]
    first, *_, last = next_step(rows, "slides")
    assert first == rows[0]["sentence"]
    assert last.startswith("no recording helps with slide.armature: measure it")
    assert advise(servo, result(parameters, np.array([0.01, 0.01])), seen(0.01, 0.01), threads=1) == ()


def test_knowledge_of_a_calibration_narrows_the_draws(servo: RobotModel) -> None:
    """Members come from the distribution, and what is known counts as known."""
    parameters = space("mass", "damping")
    known = ParameterDistribution(
        space=parameters, mean=parameters.nominal, covariance=np.diag([1e-4, 1e-4]), latency_s=(1e-3, 2e-3)
    )
    experiment = Experiment(servo, known, 1.0, 6, np.random.default_rng(0), threads=1)
    np.testing.assert_allclose(experiment.scenario.theta[:, 0], MASS, rtol=0.05)
    assert np.all((experiment.scenario.latency_s >= 1e-3) & (experiment.scenario.latency_s <= 2e-3))
    assert experiment.prior.gain(np.diag([1e-4, 1e-4])) == pytest.approx(0.0, abs=1e-6)
