"""Parameter spaces and distributions: the unit cube, known values, ranges, JSON."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.calibration import CalibrationResult
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace


def parameter(name: str, low: float = 0.1, high: float = 10.0, **changes: object) -> Parameter:
    """Return a parameter with nominal 1."""
    values: dict[str, object] = {
        "name": name,
        "kind": "body_mass",
        "elements": ("cart",),
        "unit": "kg",
        "nominal": 1.0,
        "low": low,
        "high": high,
    }
    return Parameter(**{**values, **changes})  # type: ignore[arg-type]


SPACE = ParameterSpace(
    [
        parameter("mass"),
        parameter("offset", -1.0, 3.0, scale="linear", unit="m"),
        parameter("weighed", known=True),
    ]
)


@pytest.mark.parametrize(
    ("unit", "low", "high", "words"),
    [
        ("kg", -1.0, 2.0, r"is -1 kg; allowed: 0 to 1e\+06 kg \(a large excavator"),
        ("kg", 1.0, 1e7, r"is 1e\+07 kg; allowed: up to 1e\+06 kg"),
        ("rad/s", -2e4, 2.0, r"is -20000 rad/s; allowed: -10000 to 10000 rad/s"),
        ("N·m·s³/rad³", 0.0, 1e13, r"is 1e\+13 N·m·s³/rad³; allowed: up to 1e\+12"),
        ("-", -1.0, 1e13, r"is 1e\+13; allowed: up to 1e\+12 \("),
    ],
)
def test_what_no_robot_has_is_no_range(unit: str, low: float, high: float, words: str) -> None:
    """Of units in the table, of others, and of factors; a mass is never below 0."""
    with pytest.raises(ConfigurationError, match=words):
        parameter("a", low, high, unit=unit, scale="linear")


def test_cube_by_hand() -> None:
    """Log range 0.1 to 10: 1 is the middle, 10^0.5 three quarters; linear range -1 to 3: 0 is a quarter."""
    np.testing.assert_allclose(SPACE.normalize(np.array([10**0.5, 0.0])), [0.75, 0.25])
    np.testing.assert_allclose(SPACE.unnormalize(np.array([0.5, 0.5])), [1.0, 1.0])
    np.testing.assert_allclose(SPACE.width, [np.log(100.0), 4.0])


def test_the_end_of_an_interval_without_limit_is_infinite() -> None:
    """A parameter that the data do not show may have an interval of thousands of e-folds: no warning."""
    np.testing.assert_array_equal(
        SPACE.from_scale(np.array([[-2000.0, 0.0], [2000.0, 1.0]])), [[0, 0], [np.inf, 1]]
    )


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(0, 1), min_size=2, max_size=2))
def test_cube_there_and_back(unit: list[float]) -> None:
    """Normalising undoes unnormalising, and what comes out of the cube lies in the range."""
    theta = SPACE.unnormalize(np.array(unit))
    np.testing.assert_allclose(SPACE.normalize(theta), unit, atol=1e-12)
    assert np.all(theta >= SPACE.low * (1 - 1e-12) - 1e-12) and np.all(theta <= SPACE.high * (1 + 1e-12))


def test_known_parameters_are_not_searched() -> None:
    """Known values are kept beside the free ones, and measuring one takes it out of the search."""
    assert SPACE.names == ("mass", "offset") and SPACE.known == {"weighed": 1.0}
    assert SPACE.with_known({"mass": 20.0}).known == {"mass": 20.0, "weighed": 1.0}
    assert SPACE.with_free(["weighed"]).names == ("weighed",)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"low": 2.0, "high": 2.0}, "low < high"),
        ({"low": 3.0, "high": 2.0}, "low < high"),
        ({"low": float("nan")}, "low < high"),
        ({"low": -1.0}, "log scale needs a positive range"),
        ({"nominal": 50.0}, "lies outside"),
    ],
)
def test_useless_ranges_are_refused(changes: dict[str, float], words: str) -> None:
    """The error names the parameter and what is wrong with its range."""
    with pytest.raises(ConfigurationError, match=words):
        parameter("mass", **changes)


def test_unknown_names_list_the_names() -> None:
    """Every way to name a parameter answers a wrong name with the right ones."""
    for use in (
        lambda: SPACE["weight"],
        lambda: SPACE.with_free(["weight"]),
        lambda: SPACE.with_known({"weight": 1.0}),
        lambda: SPACE.with_range("weight", 1.0, 2.0),
    ):
        with pytest.raises(UnknownNameError, match=r"weight.*mass, offset, weighed"):
            use()


def test_json_there_and_back() -> None:
    """A space and a distribution come back from their JSON text with the same digest."""
    known = ParameterDistribution(
        space=SPACE, mean=np.array([2.0, 0.5]), covariance=np.diag([0.01, 0.04]), latency_s=(0.01, 0.02)
    )
    again = ParameterDistribution.from_json(json.loads(json.dumps(known.to_json())))
    assert again.digest() == known.digest()
    assert ParameterSpace.from_json(json.loads(json.dumps(SPACE.to_json()))).names == SPACE.names
    with pytest.raises(ConfigurationError, match="not a parameter distribution"):
        ParameterDistribution.from_json({"format": "something else"})


def test_distributions_draw_what_they_say() -> None:
    """A Gaussian in log space has the stated spread; uniform fills the range; a point is a point."""
    rng = np.random.default_rng(0)
    gauss = ParameterDistribution(
        space=SPACE, mean=np.array([1.0, 0.0]), covariance=np.diag([0.04, 0.01]), latency_s=(0.0, 0.02)
    )
    draws = gauss.sample(rng, 20_000)
    assert np.std(np.log(draws[:, 0])) == pytest.approx(0.2, rel=0.03)
    assert np.std(draws[:, 1]) == pytest.approx(0.1, rel=0.03)
    flat = ParameterDistribution.uniform(SPACE, (0.0, 0.02)).sample(rng, 20_000)
    np.testing.assert_allclose(SPACE.normalize(flat).mean(axis=0), 0.5, atol=0.01)
    point = ParameterDistribution.point(SPACE, np.array([3.0, 1.5]), 0.01)
    np.testing.assert_allclose(point.sample(rng, 3), [[3.0, 1.5]] * 3)
    np.testing.assert_array_equal(point.sample_latency(rng, 2), [0.01, 0.01])
    assert gauss.sample_latency(rng, 1000).max() <= 0.02


def test_result_there_and_back() -> None:
    """A result comes back from its JSON text; intervals make a distribution where no covariance is."""
    result = CalibrationResult(
        method="eki",
        space=SPACE,
        estimate=np.array([2.0, 0.5]),
        interval=np.array([[1.8, 2.2], [0.4, 0.6]]),
        verdicts=("identifiable", "weak"),
        latency_s=0.012,
        latency_interval_s=(0.0115, 0.0125),
        alarms=(Finding.alarm("x", "y", "z"),),
        heldout_nrmse={"nominal": 0.3},
    )
    again = CalibrationResult.from_json(json.loads(json.dumps(result.to_json())))
    np.testing.assert_array_equal(again.interval, result.interval)
    assert (
        again.verdicts == result.verdicts
        and again.alarms == (Finding.alarm("x", "y", "z"),)
        and again.latency_s == 0.012
    )
    covariance = again.distribution().covariance
    assert covariance is not None
    # The linear one: (0.6 - 0.4) / 2 / 1.645 = 0.0608.
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.0608, abs=1e-4)


def damaged(**changes: Any) -> dict[str, Any]:
    """Return the values of a good distribution of two parameters with some of them replaced."""
    space = ParameterSpace(
        [
            Parameter.around("a", "mass", ["x"], "kg", 1.0),
            Parameter(
                name="b",
                kind="bias",
                elements=("y",),
                unit="rad",
                nominal=0.0,
                low=-1.0,
                high=1.0,
                scale="linear",
            ),
        ]
    )
    good = ParameterDistribution(
        space=space, mean=space.nominal, covariance=np.diag([0.01, 0.02]), latency_s=(0.0, 0.01)
    )
    return {**good.to_json(), **changes}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"mean": {"a": float("nan"), "b": 0.0}}, "mean"),
        ({"mean": {"a": -1.0, "b": 0.0}}, "mean.a is -1"),
        ({"mean": {"a": [1.0], "b": 0.0}}, "mean"),
        ({"covariance": [[float("nan"), 0.0], [0.0, 1.0]]}, "covariance"),
        ({"covariance": [[1e300, 0.0], [0.0, 1.0]]}, "covariance"),
        ({"covariance": [[1.0, 0.5], [0.0, 1.0]]}, "covariance"),
        ({"covariance": [[-1.0, 0.0], [0.0, 1.0]]}, "covariance"),
        ({"covariance": [[1.0]]}, "covariance"),
        ({"covariance": "x"}, "covariance"),
        ({"latency_s": [0.01, 0.0]}, "latency_s"),
        ({"latency_s": [0.0, float("inf")]}, "latency_s"),
        ({"latency_s": [0.0, 12.0]}, "latency_s"),
    ],
)
def test_a_distribution_that_cannot_be_drawn_from_is_refused(changes: dict[str, Any], field: str) -> None:
    """It is refused when it is read, by the field, and not by a policy that learnt from NaN."""
    with pytest.raises(ConfigurationError, match=f"^(field )?{field}"):
        ParameterDistribution.from_json(damaged(**changes))


@settings(max_examples=100, deadline=None)
@given(
    mean=st.tuples(st.floats(), st.floats()),
    spread=st.tuples(st.floats(), st.floats()),
    latency=st.floats(),
    covariance=st.floats(),
)
def test_what_is_read_gives_finite_draws(
    mean: tuple[float, float], spread: tuple[float, float], latency: float, covariance: float
) -> None:
    """Whatever numbers a file holds: refused, or every draw is finite and inside its range."""
    values = damaged(
        mean={"a": mean[0], "b": mean[1]},
        latency_s=[0.0, latency],
        covariance=[[spread[0], covariance], [covariance, spread[1]]],
    )
    try:
        found = ParameterDistribution.from_json(values)
    except ConfigurationError as error:
        assert "\n" not in str(error)
        return
    rng = np.random.default_rng(0)
    draws = found.sample(rng, 20)
    assert np.isfinite(draws).all() and np.isfinite(found.sample_latency(rng, 20)).all()
    assert (draws >= found.space.low).all() and (draws <= found.space.high).all()
