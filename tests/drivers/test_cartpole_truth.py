"""Hidden truths: reproducible, in range, balanced by the oracle; and the balancer itself."""

import dataclasses
import json

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, SPACES, k9_space
from deal_hw.drivers.cartpole.emulator import oracle
from deal_hw.drivers.cartpole.emulator.lqr import LqrController, design_lqr, linearise
from deal_hw.drivers.cartpole.emulator.oracle import balances, draw_truth, oracle_balances
from deal_hw.drivers.cartpole.plant.mechanics import Mechanics
from deal_hw.drivers.cartpole.plant.profiles import PROFILES
from deal_hw.drivers.cartpole.plant.sensor import Sample, Sensor
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth, candidate_truth, nominal_truth
from deal_hw.errors import ConfigurationError, UnknownNameError


@pytest.mark.parametrize("profile", PROFILES)
def test_a_seed_decides_the_truth(profile: str) -> None:
    """The same seed draws the same truth, another seed another one."""
    assert draw_truth(profile, 3) == draw_truth(profile, 3)
    assert draw_truth(profile, 3).parameters != draw_truth(profile, 4).parameters


def test_candidates_lie_in_the_inner_part_of_the_range() -> None:
    """Within 80 % of the range's half width, |ln ratio| <= 0.8 ln 5; latency 5 to 25 ticks."""
    rng = np.random.default_rng(0)
    truths = [candidate_truth("sensor", rng, seed=0, range_ratio=5.0, refused=0) for _ in range(300)]
    for parameter in k9_space():
        ratios = np.log([t.parameters[parameter.name] / parameter.nominal for t in truths])
        assert np.max(np.abs(ratios)) <= 0.8 * np.log(5) + 1e-12
        assert np.max(np.abs(ratios)) > 0.75 * np.log(5)
        assert abs(np.mean(ratios)) < 0.15
    for known, value in k9_space().known.items():
        assert all(t.parameters[known] == value for t in truths)
    totals = {t.actuation_ticks + t.sensing_ticks for t in truths}
    assert totals == set(range(5, 26))


@pytest.mark.parametrize("name", SPACES)
def test_a_truth_is_drawn_in_the_space_that_is_named(name: str) -> None:
    """Free parameters fill the inner part of the space's own range, known ones have their value."""
    space = SPACES[name]()
    rng = np.random.default_rng(0)
    truths = [
        candidate_truth("ideal", rng, seed=0, range_ratio=5.0, refused=0, space=space) for _ in range(100)
    ]
    ranged = space.with_ratio(5.0)
    share = ranged.normalize(np.array([[t.parameters[p.name] for p in space] for t in truths]))
    assert 0.1 - 1e-9 < share.min() and share.max() < 0.9 + 1e-9
    assert share.min(axis=0).max() < 0.2 and share.max(axis=0).min() > 0.8
    for known, value in space.known.items():
        assert all(t.parameters[known] == value for t in truths)


def test_friction_at_rest_is_a_truths_own_where_it_has_one() -> None:
    """A force of 1.2 times the friction in motion moves the cart; not where half as much comes at rest."""

    def moved(**laws: float) -> float:
        usual = nominal_truth()
        mechanics = Mechanics(dataclasses.replace(usual, parameters={**usual.parameters, **laws}))
        mechanics.release()
        start = mechanics.position[0]
        for _ in range(200):
            mechanics.step(1.2 * usual.parameters["cart.frictionloss"])
        return abs(mechanics.position[0] - start)

    free = moved()
    held = moved(**{"cart.friction_stribeck": 0.5 * nominal_truth().parameters["cart.frictionloss"]})
    assert held < 0.1 * free


def test_laws_of_a_truth_survive_json() -> None:
    """A truth without them has none afterwards."""
    with_laws = draw_truth("ideal", 2, space=SPACES["laws"]())
    assert {"cart.friction_stribeck", "cart.stribeck_speed"} < set(with_laws.parameters)
    assert CartpoleTruth.from_json(json.loads(json.dumps(with_laws.to_json()))) == with_laws
    assert "cart.friction_stribeck" not in draw_truth("ideal", 2).parameters


def test_without_a_space_a_truth_is_the_one_of_k9() -> None:
    """Rows of earlier versions keep their robots."""
    assert draw_truth("sensor", 3) == draw_truth("sensor", 3, space=k9_space())
    assert draw_truth("sensor", 3) != draw_truth("sensor", 3, space=SPACES["paper"]())


def test_the_ideal_profile_has_no_latency() -> None:
    """Ideal means equations only."""
    truth = candidate_truth("ideal", np.random.default_rng(1), seed=1, range_ratio=5.0, refused=0)
    assert truth.latency_s == 0.0


@pytest.mark.parametrize("profile", PROFILES)
def test_the_latency_is_the_mean_delay_from_a_command_to_a_state_that_shows_it(profile: str) -> None:
    """300 commands and 300 frames, by the device's own ticks: either mean is known to 0.07 ticks."""
    truth = nominal_truth(profile, actuation_ticks=3, sensing_ticks=4)
    exact = dataclasses.replace(PROFILES[profile], sensor=PROFILES["ideal"].sensor)
    sensor, ages = Sensor(exact, truth.sensing_ticks, 200, np.random.default_rng(5)), []
    for tick in range(1500):
        sensor.observe(Sample(tick * 1e-3, 0.0, 0.0, 0.0, 0.0))
        if tick % 5 == 4 and tick > 50:
            ages.append(tick - sensor.read().cart_um / 1e3)
    mechanics = Mechanics(truth)
    late = [mechanics.command_delay() for _ in range(300)]
    assert 1e3 * truth.latency_s == pytest.approx(np.mean(late) + np.mean(ages), abs=0.3)


def test_the_truth_survives_json() -> None:
    """What --reveal-to writes can be read again."""
    truth = draw_truth("sensor", 1)
    assert CartpoleTruth.from_json(json.loads(json.dumps(truth.to_json()))) == truth
    with pytest.raises(ConfigurationError, match="reveal-to"):
        CartpoleTruth.from_json({"profile": "ideal"})


def test_an_impossible_truth_is_refused() -> None:
    """A motor of 0.1 N under 0.5 N of dry friction balances nothing; the nominal one does."""
    nominal = nominal_truth("sensor", actuation_ticks=4, sensing_ticks=4)
    weak = CartpoleTruth(
        profile="sensor",
        seed=0,
        parameters={**nominal.parameters, "servo.effort_limit": 0.1, "cart.frictionloss": 0.5},
    )
    assert oracle_balances(nominal)
    assert not oracle_balances(weak)


def test_a_truth_that_is_drawn_again_is_not_balanced_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second draw of a seed is the same and simulates nothing; another seed's draw does."""
    simulated: list[CartpoleTruth] = []

    def noted(truth: CartpoleTruth, controller: LqrController, start_angle_rad: float) -> bool:
        simulated.append(truth)
        return True

    monkeypatch.setattr(oracle, "balances", noted)
    oracle._holds.cache_clear()
    try:
        first = draw_truth("sensor", 1)
        assert draw_truth("sensor", 1) == first and simulated == [first] * 2
        assert draw_truth("sensor", 2) != first and len(simulated) == 4
    finally:
        oracle._holds.cache_clear()


def test_settings_that_make_no_sense_are_refused() -> None:
    """Unknown profile, ratio not above 1 and negative seed are errors, not draws."""
    with pytest.raises(UnknownNameError, match="ideal, sensor, realistic"):
        draw_truth("perfect", 0)
    with pytest.raises(ConfigurationError, match="above 1"):
        draw_truth("ideal", 0, range_ratio=1.0)
    with pytest.raises(ConfigurationError, match="seed"):
        draw_truth("ideal", -1)


@pytest.mark.parametrize("latency_ticks", [0, 10, 19, 20, 33])
def test_the_balancer_stabilises_its_linear_model(latency_ticks: int) -> None:
    """Open loop the upright pole is unstable by one mode; with the feedback all modes decay."""
    model = linearise(nominal_truth().parameters, latency_ticks)
    assert np.sum(np.abs(np.linalg.eigvals(model.A)) > 1.0) == 1
    controller = design_lqr(nominal_truth().parameters, latency_ticks, DESCRIPTION.sensor)
    closed = model.A - model.B @ controller._feedback[None]
    assert np.max(np.abs(np.linalg.eigvals(closed))) < 1.0


def test_planning_for_latency_matters() -> None:
    """At 25 ms the balancer that knows it holds the pole; its state has one past target a period."""
    truth = nominal_truth("sensor", actuation_ticks=15, sensing_ticks=10)
    controller = design_lqr(truth.parameters, 25, PROFILES["sensor"].sensor)
    assert balances(truth, controller, 0.03)
    assert [len(linearise(truth.parameters, ticks).A) for ticks in (18, 19, 38, 39)] == [5, 6, 6, 7]
