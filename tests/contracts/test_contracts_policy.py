"""Policy specs and observations: what fits a robot, and what a policy gets to see."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import pytest
from fakes.linear_policy import feedback_spec
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.go2.descriptions.driver import DRIVER
from deal_hw.errors import ConfigurationError, PolicyError, PolicyMismatchError
from deal_hw.policy import (
    MAX_SPEC_CHARACTERS,
    ObservationBuilder,
    ObservationTerm,
    PolicySpec,
    Quantity,
)

SPEC = PolicySpec(
    robot="cartpole",
    joint_names=("cart", "pole"),
    actuated=("cart",),
    observation=(
        ObservationTerm("position", "cart", 2.0),
        ObservationTerm("sin_position", "pole", 1.0),
        ObservationTerm("velocity", "pole", 0.5, 1),
        ObservationTerm("action", "cart", 1.0, 1),
        ObservationTerm("action", "cart", 1.0, 2),
    ),
    action_scale=(0.25,),
    default_position=(0.0, 0.0),
    stiffness=(80.0,),
    damping=(8.0,),
    effort_limit=(4.0,),
    speed_limit=(1.0,),
    control_rate_hz=50.0,
)


def test_observation_by_hand() -> None:
    """Scales, sine, a velocity of one period ago and the last two actions, in the order of the spec."""
    builder = ObservationBuilder(SPEC)
    first = builder.build(np.array([0.1, np.pi / 6]), np.array([0.0, 2.0]))
    np.testing.assert_allclose(first, [0.2, 0.5, 1.0, 0.0, 0.0], rtol=1e-6)
    builder.record_action(np.array([0.7]))
    second = builder.build(np.array([0.2, 0.0]), np.array([0.0, 4.0]))
    np.testing.assert_allclose(second, [0.4, 0.0, 1.0, 0.7, 0.0], rtol=1e-6)
    builder.record_action(np.array([-0.3]))
    third = builder.build(np.array([0.2, 0.0]), np.array([0.0, 6.0]))
    np.testing.assert_allclose(third, [0.4, 0.0, 2.0, -0.3, 0.7], rtol=1e-6)
    builder.reset()
    again = builder.build(np.array([0.1, 0.0]), np.array([0.0, 8.0]))
    np.testing.assert_allclose(again, [0.2, 0.0, 4.0, 0.0, 0.0], rtol=1e-6)


def test_batch_builds_what_single_robots_build() -> None:
    """A batch of three, one of which is reset on the way, equals three builders of one."""
    rng = np.random.default_rng(0)
    batch, singles = ObservationBuilder(SPEC, (3,)), [ObservationBuilder(SPEC) for _ in range(3)]
    for tick in range(6):
        if tick == 3:
            batch.reset(np.array([False, True, False]))
            singles[1].reset()
        x, v, a = rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), rng.uniform(-1, 1, (3, 1))
        together = batch.build(x, v)
        alone = np.stack([one.build(x[i], v[i]) for i, one in enumerate(singles)])
        np.testing.assert_array_equal(together, alone)
        batch.record_action(a)
        for i, one in enumerate(singles):
            one.record_action(a[i])


def test_spec_there_and_back() -> None:
    """A spec comes back from its text; other text is refused."""
    assert PolicySpec.from_json(SPEC.to_json()) == SPEC
    for text in ("", "[]", "{}", '{"robot": "x", "observation": 3}'):
        with pytest.raises(PolicyError, match="not a policy spec"):
            PolicySpec.from_json(text)


def test_fit_is_checked_field_by_field() -> None:
    """A fitting policy passes; every field that differs is named with both values."""
    SPEC.check_fits(DESCRIPTION)
    wrong = dataclasses.replace(SPEC, robot="go2", control_rate_hz=100.0, stiffness=(500.0,))
    with pytest.raises(PolicyMismatchError) as caught:
        wrong.check_fits(DESCRIPTION)
    words = str(caught.value)
    assert "'go2'" in words and "100.0" in words and "500.0" in words and "joint_names" not in words


NAN, INFINITY = math.nan, math.inf


def edited(path: tuple[str | int, ...], value: object) -> str:
    """Return the text of a good spec with one value changed; a new field where there was none."""
    values = json.loads(SPEC.to_json())
    place: Any = values
    for part in path[:-1]:
        place = place[part]
    place[path[-1]] = value
    return json.dumps(values)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("observation", 2, "quantity"), "velocty", r"observation\[2\].quantity is 'velocty'; .*'velocity'"),
        (("observation", 2, "quantity"), "torque", r"observation\[2\].quantity is 'torque'; .*'position'"),
        (("observation", 2, "quantity"), None, r"observation\[2\].quantity is None"),
        (("observation", 0, "joint"), "wheel", r"observation\[0\].joint is 'wheel'; allowed: 'cart', 'pole'"),
        (("observation", 3, "joint"), "pole", r"observation\[3\].joint is 'pole'; allowed: 'cart'$"),
        (("observation", 0, "scale"), "2.0", r"observation\[0\].scale is '2.0'"),
        (("observation", 0, "scale"), True, r"observation\[0\].scale is True"),
        (("observation", 0, "scale"), 0.0, r"observation\[0\]: field scale is 0.0; allowed: a finite number"),
        (("observation", 0, "scale"), NAN, r"observation\[0\]: field scale is nan"),
        (("observation", 0, "delay"), 101, r"observation\[0\]: field delay is 101; allowed: 0 to 100"),
        (("observation", 0, "delay"), -1, r"observation\[0\]: field delay is -1"),
        (("observation", 3, "delay"), 0, r"observation\[3\]: field delay is 0; allowed: 1 to 100"),
        (("observation", 0, "delay"), 1.0, r"observation\[0\].delay is 1.0"),
        (("observation", 0, "delay"), True, r"observation\[0\].delay is True"),
        (("observation", 0, "delya"), 1, r"observation\[0\].delya is 1; Unexpected"),
        (("observation",), [], r"observation is of length 0; allowed: 1 to 4096"),
        (("observation",), "position", r"observation is 'position'"),
        (("robot",), "", r"robot is ''"),
        (("robot",), 3, r"robot is 3"),
        (("joint_names",), [], r"joint_names is \(\)"),
        (("joint_names",), ["cart", "cart"], r"joint_names is \('cart', 'cart'\); .* all different"),
        (("joint_names", 1), "", r"joint_names is \('cart', ''\)"),
        (("actuated", 0), "wheel", r"actuated\[0\] is 'wheel'; allowed: 'cart', 'pole'"),
        (("action_scale", 0), NAN, r"action_scale\[0\] is nan; allowed: a finite number"),
        (("action_scale",), [], r"action_scale is of length 0; allowed: 1"),
        (("default_position", 1), INFINITY, r"default_position\[1\] is inf"),
        (("default_position",), [0.0], r"default_position is of length 1; allowed: 2"),
        (("stiffness",), [80.0, 80.0], r"stiffness is of length 2; allowed: 1"),
        (("stiffness", 0), -1.0, r"stiffness\[0\] is -1.0; allowed: a finite number of at least 0"),
        (("damping", 0), None, r"damping\[0\] is None"),
        (("effort_limit", 0), INFINITY, r"effort_limit\[0\] is inf"),
        (("speed_limit", 0), NAN, r"speed_limit\[0\] is nan"),
        (("control_rate_hz",), 0, r"control_rate_hz is 0.0; allowed: a finite rate above 0 Hz"),
        (("control_rate_hz",), "50", r"control_rate_hz is '50'"),
        (("training",), [], r"training is \[\]"),
        (("training",), {"loss": NAN}, r"training is \{'loss': nan\}; allowed: plain JSON values"),
        (("position_units",), ["m", "deg"], r"position_units\[1\] is 'deg'; allowed: 'm', 'rad'"),
        (("position_units",), ["m"], r"position_units is \('m',\); allowed: 2 entries"),
        (("units",), "SI", r"units is 'SI'; Unexpected"),
    ],
)
def test_a_wrong_field_is_named(path: tuple[str | int, ...], value: object, words: str) -> None:
    """What was found and what is allowed, in one line that fits a terminal."""
    with pytest.raises(PolicyError, match=f"not a policy spec: (field )?{words}") as caught:
        PolicySpec.from_json(edited(path, value))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_several_wrong_fields_are_named_together() -> None:
    """Three are explained, the others counted."""
    values = json.loads(SPEC.to_json())
    for term in values["observation"]:
        term["scale"] = "big"
    with pytest.raises(PolicyError, match=r"\[0\].scale .*\[1\].scale .*\[2\].scale .*; and 2 more$"):
        PolicySpec.from_json(json.dumps(values))


@pytest.mark.parametrize(
    "text", ["", "[" * 100_000, '{"robot": "\\ud800"}', " " * MAX_SPEC_CHARACTERS + "{}"]
)
def test_text_that_is_no_json_is_refused(text: str) -> None:
    """Nothing, deep nesting, a torn character, a text without end."""
    with pytest.raises(PolicyError, match="not a policy spec"):
        PolicySpec.from_json(text)


def test_specs_made_in_python_are_checked_too() -> None:
    """A quantity or a joint that is not there, an action that is not taken yet, an endless history."""
    for words, term in (
        ("quantity is 'torque'", {"quantity": "torque", "joint": "cart"}),
        ("allowed: an axis of 'gravity': 'x', 'y', 'z'", {"quantity": "gravity", "joint": "cart"}),
        ("delay is 0; allowed: 1 to 100", {"quantity": "action", "joint": "cart"}),
        ("delay is 1000000000", {"quantity": "position", "joint": "cart", "delay": 10**9}),
        ("delay is True", {"quantity": "position", "joint": "cart", "delay": True}),
    ):
        with pytest.raises(ConfigurationError, match=words):
            ObservationTerm(**{"scale": 1.0, **term})  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="wheel"):
        dataclasses.replace(SPEC, observation=(ObservationTerm("position", "wheel", 1.0),))
    with pytest.raises(ConfigurationError, match=r"training is .* plain JSON values"):
        dataclasses.replace(SPEC, training={"network": object()})


@pytest.mark.parametrize("quantity", get_args(Quantity))
def test_every_known_quantity_is_built(quantity: Quantity) -> None:
    """And all differ: two that read the same would be a quantity that is taken for another."""
    # Along z the place is the height.
    element = {**dict.fromkeys(BASE, "z"), "clock": "cos", "place": "x", "target_rotation": "y"}
    element["obstacle"] = "height"
    spec = dataclasses.replace(
        feedback_spec(DRIVER),
        clock_hz=2.5,
        observation=tuple(
            ObservationTerm(q, element.get(q, DRIVER.joint_names[0]), 1.0, int(q == "action"))
            for q in (quantity, *(other for other in get_args(Quantity) if other != quantity))
        ),
    )
    builder = ObservationBuilder(spec)
    builder.command, builder.obstacle = np.array([0.1, 0.2, 0.77]), np.array([1.1, 0.13])
    builder.record_action(np.full(12, 0.35))
    rng = np.random.default_rng(1)
    built = builder.build(rng.uniform(0.2, 1.0, 18), rng.uniform(0.2, 1.0, 18))
    assert len(set(built.tolist())) == len(get_args(Quantity))


def test_the_clock_turns_from_the_first_observation_on() -> None:
    """At 2.5 turns a second and 50 Hz each observation is a twentieth of a turn on; a reset starts anew."""
    clock = tuple(ObservationTerm("clock", axis, 2.0) for axis in ("sin", "cos"))
    spec = dataclasses.replace(feedback_spec(DRIVER), observation=clock, clock_hz=2.5)
    assert PolicySpec.from_json(spec.to_json()) == spec
    builder = ObservationBuilder(spec, (2,))
    seen = [builder.build(np.zeros((2, 12)), np.zeros((2, 12))) for _ in range(6)]
    np.testing.assert_allclose(seen[0], [[0.0, 2.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(seen[5], [[2.0, 0.0]] * 2, atol=1e-6)
    builder.reset(np.array([True, False]))
    angle = 2.0 * np.pi * 0.3
    built = builder.build(np.zeros((2, 12)), np.zeros((2, 12)))
    np.testing.assert_allclose(built, [[0.0, 2.0], [2 * np.sin(angle), 2 * np.cos(angle)]], atol=1e-6)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"clock_hz": 2.5}, "clock_hz is 2.5; allowed: 0, as no clock is observed"),
        ({"command_range": ((0.0, 1.0),)}, "command_range is .*; allowed: 3 pairs"),
        ({"command_range": ((1.0, 0.0),) * 3}, "command_range is .*; allowed: 3 pairs"),
        (
            {"observation": (ObservationTerm("clock", "sin", 1.0),), "clock_hz": 25.0},
            "clock_hz is 25.0; allowed: above 0 and below half the control rate, 25 Hz",
        ),
    ],
)
def test_clocks_and_ranges_that_cannot_be_are_refused(fields: dict[str, Any], words: str) -> None:
    """And a spec without them is written as before they existed, so that its digest stays."""
    with pytest.raises(ConfigurationError, match=words):
        dataclasses.replace(feedback_spec(DRIVER), **fields)
    assert not {"clock_hz", "command_range"} & json.loads(feedback_spec(DRIVER).to_json()).keys()


BASE = ("gravity", "heading", "angular_velocity", "linear_velocity", "height", "command")

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of each value inside a JSON value."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in inside:
        yield (*path, key)
        yield from places(child, (*path, key))


PLACES = tuple(places(json.loads(SPEC.to_json())))


def check_either_refused_or_sound(text: str) -> None:
    try:
        spec = PolicySpec.from_json(text)
    except PolicyError as err:
        assert "\n" not in str(err)
        return
    assert PolicySpec.from_json(spec.to_json()) == spec
    J = len(spec.joint_names)
    builder = ObservationBuilder(spec)
    base = 6 if spec.observes_base else 0
    with np.errstate(over="ignore"):
        for _ in range(2):
            built = builder.build(np.full(base + J, 0.1), np.full(base + J, 0.2))
            assert built.shape == (len(spec.observation),) and not np.isnan(built).any()
            builder.record_action(np.zeros(len(spec.actuated)))


@given(plain)
def test_any_json_is_refused_or_a_spec(value: Any) -> None:
    """No other error than PolicyError, whatever the JSON."""
    check_either_refused_or_sound(json.dumps(value))


@settings(max_examples=400)
@given(st.lists(st.tuples(st.sampled_from(PLACES), plain | st.just("velocity")), min_size=1, max_size=3))
def test_a_damaged_spec_is_refused_or_works(damages: list[tuple[tuple[str | int, ...], Any]]) -> None:
    """Any values in the places of others: what is accepted builds observations and survives JSON."""
    values = copy.deepcopy(json.loads(SPEC.to_json()))
    for path, value in damages:
        place: Any = values
        try:
            for part in path[:-1]:
                place = place[part]
            place[path[-1]] = value
        except (TypeError, KeyError, IndexError):
            continue  # An earlier damage took this place away.
    check_either_refused_or_sound(json.dumps(values))


def test_the_units_of_positions_are_compared_where_they_are_noted() -> None:
    """A policy trained on a pole in metres is another robot's; one that notes nothing passes."""
    dataclasses.replace(SPEC, position_units=("m", "rad")).check_fits(DESCRIPTION)
    with pytest.raises(PolicyMismatchError, match=r"position_units: policy has \('m', 'm'\), robot has"):
        dataclasses.replace(SPEC, position_units=("m", "m")).check_fits(DESCRIPTION)
    assert "position_units" not in SPEC.to_json()


def test_a_policy_of_another_robot_is_refused_in_a_few_words() -> None:
    """Three fields with short values, the others by name."""
    with pytest.raises(PolicyMismatchError, match="policy has 'go2', robot has 'cartpole'") as caught:
        feedback_spec(DRIVER).check_fits(DESCRIPTION)
    words = str(caught.value)
    assert len(words) < 500
    assert "also: position_units, default_position" in words and "speed_limit" in words


def test_description_digest_changes_with_facts_not_with_sources() -> None:
    """A mended source leaves recordings and policies valid; a changed limit does not."""
    assert dataclasses.replace(DESCRIPTION, sources={}).digest() == DESCRIPTION.digest()
    assert dataclasses.replace(DESCRIPTION, stiffness=(81.0,)).digest() != DESCRIPTION.digest()
    with pytest.raises(ConfigurationError, match="stiffness has 2 entries, expected 1"):
        dataclasses.replace(DESCRIPTION, stiffness=(1.0, 2.0))
    with pytest.raises(ConfigurationError, match="wheel"):
        dataclasses.replace(DESCRIPTION, actuated=("wheel",))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"action_limit": 0.0}, "action_limit is 0.0; allowed: a number above 0, or Infinity"),
        ({"action_limit": math.nan}, "action_limit is nan"),
        ({"action_offset": (0.0,) * 3}, "action_offset is of length 3; allowed: 12"),
        ({"action_offset": (math.inf,) * 12}, r"action_offset\[0\] is inf"),
        ({"target_range": ((0.0, 1.0),)}, r"target_range is .*; allowed: 12 pairs"),
        ({"target_range": ((1.0, 0.0),) * 12}, r"target_range is .*; allowed: 12 pairs"),
        ({"clock_rest": -0.1}, "clock_rest is -0.1; allowed: a finite number of at least 0"),
    ],
)
def test_fields_of_imported_policies_are_checked(fields: dict[str, Any], words: str) -> None:
    """Centres, limits and ranges of actions, and the clock at rest."""
    with pytest.raises(ConfigurationError, match=words):
        PolicySpec.of_robot(
            DRIVER, [ObservationTerm("clock", "sin", 1.0)], (1.0,) * 12, clock_hz=2.0, **fields
        )


def test_a_policy_with_its_own_centre_has_its_own_pose() -> None:
    """The robot's default pose may be another: targets and observations are around the policy's."""
    other = tuple(value + 0.1 for value in DRIVER.default_position)
    terms = [ObservationTerm("position", name, 1.0) for name in DRIVER.joint_names]
    spec = PolicySpec.of_robot(
        DRIVER,
        terms,
        (0.5,) * 12,
        default_position=other,
        effort_limit=tuple(map(min, DRIVER.effort_limit, DRIVER.limits.effort)),
    )
    with pytest.raises(PolicyMismatchError, match="default_position: policy has"):
        spec.check_fits(DRIVER)
    own = dataclasses.replace(spec, action_offset=other, action_limit=math.inf)
    own.check_fits(DRIVER)
    again = PolicySpec.from_json(own.to_json())
    assert again == own and again.digest() != spec.digest()


def test_the_clock_is_zero_at_rest_and_turns_on() -> None:
    """Its phase goes on; with delayed commands and clocks the past ones are seen."""
    terms = [ObservationTerm("clock", "sin", 1.0, delay) for delay in (0, 1)]
    terms += [ObservationTerm("command", "x", 1.0, delay) for delay in (0, 1)]
    fields: dict[str, Any] = {"clock_hz": 12.5, "clock_rest": 0.1, "delayed_commands": True}
    builder = ObservationBuilder(PolicySpec.of_robot(DRIVER, terms, (1.0,) * 12, **fields))
    state = np.zeros(12), np.zeros(12)
    seen = []
    for speed in (0.0, 0.5, 0.5, 0.05):
        builder.command = np.array([speed, 0.0, 0.0])
        seen.append(builder.build(*state))
    # A quarter of a turn each period: sines 0, 1, 0, -1, the first and the last at rest.
    wanted = np.array([[0, 0, 0, 0], [1, 0, 0.5, 0], [0, 1, 0.5, 0.5], [0, 0, 0.05, 0.5]])
    np.testing.assert_allclose(np.array(seen), wanted, atol=1e-6)
