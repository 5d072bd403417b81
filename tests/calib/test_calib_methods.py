"""Every method in the table keeps the contract, and the searches find the true parameters."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from fakes.recorded_commands import RecordedCommands

from deal_hw.bench.tasks import Case as Demonstration
from deal_hw.bench.tasks import make_case
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.data.resume import SearchCheckpoint
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.paper.algorithm1 import DealPaper, PaperSettings, _Box
from deal_hw.calib.paper.critic import CriticSettings
from deal_hw.calib.pipeline.methods import (
    CLOSED_LOOP_METHODS,
    DEFAULT_SEARCH,
    METHODS,
    NO_DATA_METHODS,
    SEARCHES,
    SEARCHING,
    UNALIGNED_METHODS,
    check_method,
    make_method,
    usual_population,
    with_search,
)
from deal_hw.calib.pipeline.stages import CalibrationPipeline
from deal_hw.calib.search.deal import Deal, DealSettings
from deal_hw.calib.search.eki import NEAR_SPREAD, Eki
from deal_hw.calib.search.unaligned import Unaligned, UnalignedSettings
from deal_hw.calib.validation.settings import Validation
from deal_hw.calibration import EXPLAINED_CHI2, Budget, CalibrationResult, Progress
from deal_hw.errors import ConfigurationError, InsufficientDataError, UnknownNameError
from deal_hw.parameters import ParameterSpace
from deal_hw.testing.method_suite import MethodCase, MethodSuite

FREE = ("cart.frictionloss", "servo.damping")
SECONDS = 1.2


@functools.cache
def recorded(profile: str, seed: int) -> Demonstration:
    """Return a demonstration of a tuning seed; made once for all tests of this file."""
    return make_case("cartpole", profile, seed, 5.0)


def two_parameters() -> tuple[ParameterSpace, np.ndarray[tuple[int], np.dtype[np.float64]]]:
    """Return a space in which all but two parameters are known, and the two true values."""
    d = recorded("ideal", 1)
    truth = dict(zip(d.space.names, d.theta, strict=True))
    space = d.space.with_known({name: value for name, value in truth.items() if name not in FREE})
    return space, np.array([truth[name] for name in space.names])


def small_problem() -> Problem:
    """Return the first 1.2 s of a noise-free demonstration, two parameters free, latency given."""
    d = recorded("ideal", 1)
    fit = d.fit
    samples = int(SECONDS * 200) + 1
    steps = int(fit.sample[samples - 1])
    states = ("sample", "position", "velocity", "usable")
    commands = ("target", "stiffness", "damping", "effort_limit", "speed_limit")
    short = dataclasses.replace(
        fit,
        **{name: getattr(fit, name)[:samples] for name in states},
        **{name: getattr(fit, name)[:steps] for name in commands},
    )
    return Problem(
        d.robot,
        two_parameters()[0],
        [short],
        threads=1,
        fixed_latency_s=0.0,
        policy=RecordedCommands.of(short.target, 20),
    )


def case_of(name: str, budget: Budget, tolerance: float | None) -> MethodCase:
    """Return the suite's case of a method by name."""
    return MethodCase(
        method=make_method(name),
        make_problem=small_problem,
        truth=two_parameters()[1],
        budget=budget,
        short_budget=Budget(population=10, generations=2),
        tolerance=tolerance,
        open_store=SearchCheckpoint,
    )


class TestEki(MethodSuite):
    """`eki`: within 0.1 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("eki", Budget(population=20, generations=25), 1e-3)


class TestDeal(MethodSuite):
    """`deal`: within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal", Budget(population=30, generations=20), 5e-3)


@pytest.mark.slow
class TestDealCritic(MethodSuite):
    """`deal-critic`: the critic's features alone, within 3 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-critic", Budget(population=30, generations=20), 0.03)


class TestDealUntrained(MethodSuite):
    """`deal-untrained`: innovations and the features of a critic's first weights, within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-untrained", Budget(population=30, generations=20), 5e-3)


class TestDealNoCritic(MethodSuite):
    """`deal-no-critic`: the innovations alone, within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-no-critic", Budget(population=30, generations=20), 5e-3)


@pytest.mark.slow
class TestDealPaper(MethodSuite):
    """`deal-paper`: nearer than the centre, no more; single runs end at 0.08 to 0.46."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        case = case_of("deal-paper", Budget(population=100, generations=25), 0.4)
        return dataclasses.replace(case, seeds=5)


class TestDealPaperFlat(MethodSuite):
    """`deal-paper-flat` keeps the contract without reading the data."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-flat", Budget(population=10, generations=3), None)


@pytest.mark.slow
class TestDealPaperReplayed(MethodSuite):
    """`deal-paper-replay`: the same without the policy."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        case = case_of("deal-paper-replay", Budget(population=10, generations=2), None)
        make = functools.partial(dataclasses.replace, small_problem(), policy=None)
        return dataclasses.replace(case, make_problem=make)

    def test_with_the_same_commands_it_is_the_closed_loop_method(
        self, case: MethodCase, short: CalibrationResult
    ) -> None:
        """The small problem's policy sends what was recorded, so both methods end at the same place."""
        closed = case_of("deal-paper", case.budget, case.tolerance).run(case.short_budget)
        np.testing.assert_array_equal(short.estimate, closed.estimate)


class TestDealPaperLiteral(MethodSuite):
    """`deal-paper-literal` keeps the contract; it does not find anything."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        # Its critic is trained against all rollouts so far.
        case = case_of("deal-paper-literal", Budget(population=10, generations=2), None)
        return dataclasses.replace(case, grows=True)


@pytest.mark.slow
class TestDealPaperLiteralWithoutNoiseAdaptation(MethodSuite):
    """`deal-paper-literal-fn` keeps the contract."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        case = case_of("deal-paper-literal-fn", Budget(population=10, generations=2), None)
        return dataclasses.replace(case, grows=True)


@pytest.mark.slow
class TestDealPaperLiteralWithoutNormalisation(MethodSuite):
    """`deal-paper-literal-pn` keeps the contract in SI units from zero."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        case = case_of("deal-paper-literal-pn", Budget(population=10, generations=2), None)
        return dataclasses.replace(case, grows=True)


class TestDealPaperLiteralFlat(MethodSuite):
    """`deal-paper-literal-flat` keeps the contract without reading the data."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-literal-flat", Budget(population=10, generations=3), None)


@pytest.mark.slow
class TestDealPaperWithoutNoiseAdaptation(MethodSuite):
    """`deal-paper-fn` keeps the contract."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-fn", Budget(population=10, generations=2), None)


@pytest.mark.slow
class TestDealPaperWithoutNormalisation(MethodSuite):
    """`deal-paper-pn` keeps the contract in raw units."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-pn", Budget(population=10, generations=2), None)


class TestDealUnaligned(MethodSuite):
    """`deal-unaligned`: within 1 %; single runs end at 0.02 to 0.3 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-unaligned", Budget(population=30, generations=20), 0.01)


class TestMmdUnaligned(MethodSuite):
    """`mmd-unaligned`: within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("mmd-unaligned", Budget(population=30, generations=20), 5e-3)


class TestMomentsUnaligned(MethodSuite):
    """`moments-unaligned`: within 0.5 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("moments-unaligned", Budget(population=30, generations=20), 5e-3)


@pytest.mark.slow
class TestDealPaperEnergy(MethodSuite):
    """`deal-paper-energy`: nearer than the centre, no more; single runs end at 0.29 to 0.33."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-energy", Budget(population=100, generations=25), 0.4)


@pytest.mark.slow
class TestDealPaperMmd(MethodSuite):
    """`deal-paper-mmd`: nearer than the centre, no more; single runs end at 0.32 to 0.36."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("deal-paper-mmd", Budget(population=100, generations=25), 0.4)


class TestRandom(MethodSuite):
    """`random`: the best of 600 draws in two dimensions is within 25 %."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("random", Budget(population=60, generations=10), 0.25)


class TestMidpoint(MethodSuite):
    """`midpoint` keeps the contract without reading the data."""

    @pytest.fixture(scope="class")
    @classmethod
    def case(cls) -> MethodCase:
        """Return the method under test."""
        return case_of("midpoint", Budget(population=10, generations=1), None)


@pytest.mark.parametrize("name", sorted(CLOSED_LOOP_METHODS))
def test_methods_that_need_the_policy_say_so(name: str) -> None:
    """Without it they are refused before anything is simulated, and the message names others."""
    problem = dataclasses.replace(small_problem(), policy=None)
    with pytest.raises(InsufficientDataError, match="eki, deal, deal-paper-replay"):
        make_method(name).run(problem, Budget(population=4, generations=1), np.random.default_rng(0))
    assert problem.steps == 0


def test_raw_units_differ_from_the_normalised_in_one_thing() -> None:
    """Both boxes are centred on the same simulators; only their widths differ."""
    problem = small_problem()
    for settings in (PaperSettings(), PaperSettings(normalise=False)):
        coordinates = DealPaper(settings).coordinates(problem)
        box = _Box(coordinates, settings)
        space = problem.space
        np.testing.assert_allclose(box.from_unit(np.full((1, 2), 0.5)), np.zeros((1, 2)), atol=1e-12)
        np.testing.assert_allclose(box.members(np.zeros((1, 2))).theta[0], (space.low + space.high) / 2)
    ends = _Box(coordinates, settings).from_unit(np.array([[0.0, 0.0], [1.0, 1.0]]))
    np.testing.assert_allclose(ends[1] - ends[0], space.high - space.low)


def test_the_papers_words_without_normalisation_are_si_units_from_zero() -> None:
    r"""The literal DEAL\PN moves in the parameters' own values; our variant counts from the middle."""
    problem = small_problem()
    search = make_method("deal-paper-literal-pn")
    assert isinstance(search, DealPaper)
    box = _Box(search.coordinates(problem), search.settings)
    ends = box.from_unit(np.array([[0.0, 0.0], [1.0, 1.0]]))
    np.testing.assert_allclose(ends, [problem.space.low, problem.space.high])
    np.testing.assert_allclose(box.members(ends).theta, ends)


@pytest.mark.parametrize("variant", ["", "-fn", "-pn", "-flat"])
def test_a_literal_twin_differs_from_the_literal_in_what_its_name_says(variant: str) -> None:
    """-fn drops eq. 9, -pn the normalisation, -flat the data; all else is the paper's words."""
    literal, twin = make_method("deal-paper-literal"), make_method(f"deal-paper-literal{variant}")
    assert isinstance(literal, DealPaper) and isinstance(twin, DealPaper)
    changed = {
        "": literal.settings,
        "-fn": dataclasses.replace(
            literal.settings, diffusion=dataclasses.replace(literal.settings.diffusion, adapt_noise=False)
        ),
        "-pn": dataclasses.replace(literal.settings, normalise=False),
        "-flat": dataclasses.replace(literal.settings, fitness="flat"),
    }
    assert twin.settings == changed[variant] and twin.name == f"deal-paper-literal{variant}"
    assert usual_population(twin.name) == 200
    assert (twin.name in CLOSED_LOOP_METHODS) == (variant != "-flat") == (twin.name not in NO_DATA_METHODS)


def test_without_data_the_papers_words_end_in_the_lower_part_of_each_range() -> None:
    """The box [0, 1] is pulled to its lower corner: 12 seeds, no recording read.

    In `bench paper` the truth is at (1 - 1/r) / (r - 1/r) = 1 / (r + 1) of each range of ratio r, near that
    corner. So a small error there does not show that the recording was read.
    """
    problem = small_problem()
    space, ends = problem.space, {}
    for name in ("deal-paper-literal-flat", "deal-paper-flat"):
        found = [
            make_method(name).run(problem, Budget(population=30, generations=15), np.random.default_rng(seed))
            for seed in range(12)
        ]
        ends[name] = np.mean([(r.estimate - space.low) / (space.high - space.low) for r in found])
    assert problem.steps == 0
    assert ends["deal-paper-literal-flat"] < 0.35 < 0.4 < ends["deal-paper-flat"] < 0.6


@pytest.mark.parametrize("name", METHODS)
def test_every_name_in_the_table_makes_a_method(name: str) -> None:
    """Each row imports, and names its result after itself; the default is one of the others."""
    method = make_method(name)
    assert method.name == (DEFAULT_SEARCH if name == "default" else name)
    whole = make_method(name, refine=True)
    assert isinstance(whole, CalibrationPipeline) == (
        name not in NO_DATA_METHODS | UNALIGNED_METHODS | {"mujoco-sysid"}
    )
    assert whole.name == name


def test_the_search_of_the_default_is_adversarial() -> None:
    """`deal` is the search where none is named, with a trained critic and its features."""
    assert DEFAULT_SEARCH == "deal"
    made = make_method("default", refine=True)
    assert isinstance(made, CalibrationPipeline) and isinstance(made.search, Deal)
    assert made.search.settings.features and made.search.settings.trained
    assert made.search.adversarial


def test_a_method_knows_whether_a_critic_learns_and_whether_it_searches() -> None:
    """The messages follow from the method, whatever its name is."""
    learning = {name for name in METHODS if make_method(name).adversarial}
    assert learning >= {"default", "deal", "deal-critic", "deal-paper", "deal-unaligned"}
    assert not learning & {"eki", "deal-untrained", "deal-no-critic", "deal-paper-mmd", "mmd-unaligned"}
    assert not learning & NO_DATA_METHODS
    assert {name for name in METHODS if not make_method(name).moves} == {"nominal"}


@pytest.mark.parametrize("noise", [0.0, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_parts_of_deal_differ_in_what_the_update_sees(noise: float) -> None:
    """Only a trained critic estimates a distance; each part moves the population elsewhere."""
    d = recorded("sensor" if noise else "ideal", 0)
    found = {}
    for name in ("deal", "deal-critic", "deal-untrained", "deal-no-critic"):
        problem = Problem(d.robot, d.space, [d.fit], threads=1)
        budget = Budget(population=8, generations=2)
        found[name] = make_method(name).run(problem, budget, np.random.default_rng(0))
        trained = name in ("deal", "deal-critic")
        assert ("wasserstein" in found[name].trace[-1]) == trained
    estimates = np.array([result.estimate for result in found.values()])
    assert len(np.unique(estimates, axis=0)) == len(found)


def test_a_critic_that_diverges_is_said_and_the_search_goes_on() -> None:
    """Adam with a step of 1e38 has no finite weights; the innovations still move the population."""
    wild = CriticSettings(hidden=(8, 8), learning_rate=1e38, updates=2, batch=32)
    problem, truth = small_problem(), two_parameters()[1]
    budget = Budget(population=30, generations=20)
    reported: list[Progress] = []
    result = Deal(DealSettings(critic=wild)).run(problem, budget, np.random.default_rng(0), reported.append)
    assert all("the critic diverged, its last weights go on" in one.message for one in reported)
    generations = len(result.trace)
    assert f"diverged in {generations} of {generations} generations" in result.alarms[0].seen
    assert "--search eki" in result.alarms[0].do
    assert np.abs(np.log(result.estimate / truth)).max() < 0.01


@pytest.mark.slow
def test_a_diverged_critic_is_an_alarm_of_the_refined_result_where_noise_explains_none() -> None:
    """With nominal values in place of the robot's own a residual stays, and the search before it matters."""
    wild = CriticSettings(hidden=(8, 8), learning_rate=1e38, updates=2, batch=32)
    space = recorded("ideal", 1).space.with_free(FREE)
    problem = dataclasses.replace(small_problem(), space=space, known_std=np.full(4, 1e-3))
    settings = Validation(local_first=False, cross_validation=False, split_half=False, diagnosis=False)
    method = CalibrationPipeline(Deal(DealSettings(critic=wild)), "default", settings)
    result = method.run(problem, Budget(population=10, generations=3), np.random.default_rng(0))
    assert result.chi2 > EXPLAINED_CHI2 and result.provenance["critic_diverged"] > 0
    assert "critic's training diverged" in result.alarms[-1].seen


def test_a_diverged_critic_of_distributions_is_in_the_result() -> None:
    """The alarm counts the generations; the search ends with finite values all the same."""
    wild = CriticSettings(hidden=(8, 8), learning_rate=1e38, updates=2, batch=32)
    reported: list[Progress] = []
    search = Unaligned(UnalignedSettings(critic=wild))
    result = search.run(
        small_problem(), Budget(population=10, generations=3), np.random.default_rng(0), reported.append
    )
    assert all(one.message.startswith("the critic diverged, its last weights go on") for one in reported)
    assert "diverged in 3 of 3 generations" in result.alarms[0].seen
    assert np.isfinite(result.estimate).all() and result.provenance["compares"] == "distributions"


def test_deal_without_anything_to_fit_is_refused() -> None:
    """Neither innovations nor features."""
    with pytest.raises(ConfigurationError, match="nothing is left to fit"):
        DealSettings(innovations=False, features=False)


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("pipeline", sorted(SEARCHING))
def test_a_pipeline_takes_each_search(pipeline: str, search: str) -> None:
    """The name says both; without refinement `default` is its search alone."""
    name = f"{pipeline}+{search}"
    made = make_method(name, refine=True)
    assert isinstance(made, CalibrationPipeline) and made.search.name == search and made.name == name
    assert made.settings.local_first
    assert make_method(f"default+{search}").name == search
    assert usual_population(name) == usual_population(search)
    assert with_search(pipeline, search) == (pipeline if search == DEFAULT_SEARCH else name)


def test_a_search_goes_only_into_a_pipeline_that_has_one() -> None:
    """Neither a baseline inside a pipeline, nor a search inside a fit."""
    with pytest.raises(UnknownNameError, match="unknown search 'cma'; known: deal, eki, deal-paper"):
        check_method("default+cma")
    with pytest.raises(UnknownNameError, match=r"unknown calibration method 'local\+eki'"):
        check_method("local+eki")


def test_unknown_method_lists_the_names() -> None:
    """The error of a mistyped name helps."""
    for call in (check_method, make_method):
        with pytest.raises(
            UnknownNameError, match="unknown calibration method 'dael'; known: default, eki, deal"
        ):
            call("dael")


def test_nominal_and_centre_are_what_they_say() -> None:
    """The no-data baselines: the user's model, and the middle of the range on its own scale."""
    problem = small_problem()
    rng = np.random.default_rng(0)
    nominal = make_method("nominal").run(problem, Budget(), rng)
    centre = make_method("midpoint").run(problem, Budget(), rng)
    np.testing.assert_array_equal(nominal.estimate, problem.space.nominal)
    np.testing.assert_array_equal(centre.estimate, problem.space.center)
    linear = make_method("midpoint-linear").run(problem, Budget(), rng).estimate
    np.testing.assert_allclose(linear, (problem.space.low + problem.space.high) / 2)
    assert nominal.steps == centre.steps == 0


def test_constant_fitness_does_not_find_the_truth() -> None:
    """DEAL with constant fitness: its population's mean is, over 12 seeds, the centre within its own spread.

    This is the control of every table: what this row scores, a search scores without having seen the data.
    """
    problem = small_problem()
    units = []
    for seed in range(12):
        result = make_method("deal-paper-flat").run(
            problem, Budget(population=30, generations=15), np.random.default_rng(seed)
        )
        space = problem.space
        units.append((result.estimate - space.low) / (space.high - space.low))
    values = np.array(units)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    assert problem.steps == 0
    assert np.all(np.abs(values.mean(axis=0) - 0.5) < 3.5 * error)
    assert np.all(values.std(axis=0) < 0.3)


@pytest.mark.slow
def test_eki_finds_nine_parameters_and_the_latency_of_a_noisy_robot() -> None:
    """Tuning seed 0, profile sensor: mean |ln| below 0.05 where the centre has 0.6, latency within 1 ms."""
    d = recorded("sensor", 0)
    problem = Problem(d.robot, d.space, [d.fit], threads=1)
    result = Eki().run(problem, Budget(population=60, generations=15), np.random.default_rng(0))
    assert np.mean(np.abs(np.log(result.estimate / d.theta))) < 0.05
    assert abs(result.latency_s - d.latency_s) < 1e-3
    assert result.chi2 < 3.0


@pytest.mark.slow
def test_deal_finds_nine_parameters_of_a_noisy_robot() -> None:
    """Tuning seed 0, profile sensor: mean |ln| within 0.2 where the centre is at 0.6, latency within 10 ms.

    So short a search ends 0.3 to 7 ms off, as rounding has it; on four draws 0.09 to 0.17 and at most 1.8 ms.
    """
    d = recorded("sensor", 0)
    problem = Problem(d.robot, d.space, [d.fit], threads=1)
    result = Deal().run(problem, Budget(population=60, generations=20), np.random.default_rng(0))
    assert np.mean(np.abs(np.log(result.estimate / d.theta))) < 0.2
    assert abs(result.latency_s - d.latency_s) < 10e-3


@pytest.mark.slow
@pytest.mark.parametrize(("search", "population"), [(Eki(), 60), (Deal(), 100)])
def test_a_brief_search_ends_in_the_refinements_basin(search: Eki | Deal, population: int) -> None:
    """Tuning seed 0, profile sensor: at most half the generations, refined to where the truth refines to."""
    d = recorded("sensor", 0)
    problem = Problem(d.robot, d.space, [d.fit], threads=1)
    budget = Budget(population=population, generations=30, brief=True)
    found = search.run(problem, budget, np.random.default_rng(0))
    assert found.trace[-1]["spread"] < NEAR_SPREAD
    assert len(found.trace) <= 15
    refined = refine(problem, found.estimate, found.latency_s)
    best = refine(problem, d.theta, d.latency_s)
    assert refined.theta == pytest.approx(best.theta, rel=0.02)


def test_eki_says_when_the_residual_is_not_explained() -> None:
    """A budget of two generations leaves a residual, and the result carries an alarm that says so."""
    d = recorded("sensor", 0)
    problem = Problem(d.robot, d.space, [d.fit], threads=1)
    result = Eki().run(problem, Budget(population=10, generations=2), np.random.default_rng(0))
    assert result.chi2 > 3.0
    assert "residual" in result.alarms[0].seen
