"""The limit of the predicted effort: by hand, as a property, and inside the filter."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.control.safety.filter import SafetyFilter, is_finite, keep_effort
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.drivers.go2.descriptions.driver import LEG_LIMITS
from deal_hw.types import FloatArray, JointCommand

LEGS = dataclasses.replace(LEG_LIMITS, effort=(10.0,), flail_velocity=(4.0, 5.0))
LEGGED = dataclasses.replace(DESCRIPTION, limits=dataclasses.replace(DESCRIPTION.limits, legs=LEGS))


def command(**changes: float | list[float]) -> JointCommand:
    """Return a command of no effort, or another."""
    values: dict[str, float | list[float]] = {
        "position_target": 0.0,
        "velocity_target": 0.0,
        "stiffness": 0.0,
        "damping": 0.0,
        "effort": 0.0,
        "effort_limit": 8.0,
        "speed_limit": 3.0,
        **changes,
    }
    return JointCommand(**{name: np.atleast_1d(np.asarray(value, float)) for name, value in values.items()})


def effort(made: JointCommand, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return what a drive does with a command."""
    spring = made.stiffness * (made.position_target - position)
    return spring + made.damping * (made.velocity_target - velocity) + made.effort


def keep(
    requested: JointCommand, q: float, dq: float, most: float = 10.0, low: float = -9.0, high: float = 9.0
) -> tuple[JointCommand, tuple[str, ...]]:
    """Limit the effort of one joint."""
    span = (np.array([low]), np.array([high]))
    return keep_effort(requested, np.array([q]), np.array([dq]), np.array([most]), span)


@pytest.mark.parametrize(
    ("requested", "q", "dq", "expected", "names"),
    [
        # 20 (0.5 - 0) = 10 N·m is allowed, and so is -10.
        ({"stiffness": 20.0, "position_target": 0.5}, 0.0, 0.0, {}, ()),
        ({"stiffness": 20.0, "position_target": -0.5}, 0.0, 0.0, {}, ()),
        # 20 (1.0 - 0.2) = 16 N·m: the target goes to 0.2 + 10/20 = 0.7.
        (
            {"stiffness": 20.0, "position_target": 1.0},
            0.2,
            0.0,
            {"position_target": 0.7},
            ("predicted_effort",),
        ),
        (
            {"stiffness": 20.0, "position_target": -1.0},
            -0.2,
            0.0,
            {"position_target": -0.7},
            ("predicted_effort",),
        ),
        # Damping of 2 (0 - 3) = -6 leaves 16 for the spring: 20 (0.9 - 0) = 18 goes to 0.8.
        (
            {"stiffness": 20.0, "damping": 2.0, "position_target": 0.9},
            0.0,
            3.0,
            {"position_target": 0.8},
            ("predicted_effort",),
        ),
        # A feed-forward of 4 leaves 6 for the spring: 20 x 0.3.
        (
            {"stiffness": 20.0, "effort": 4.0, "position_target": 0.5},
            0.0,
            0.0,
            {"position_target": 0.3},
            ("predicted_effort",),
        ),
        # Without a spring the feed-forward pays: 14 - 4 = 10.
        ({"effort": 14.0}, 0.0, 0.0, {"effort": 10.0}, ("predicted_effort",)),
        ({"effort": -14.0}, 0.0, 0.0, {"effort": -10.0}, ("predicted_effort",)),
        # The spring of 2 goes whole, the rest of 14 after it.
        (
            {"stiffness": 20.0, "position_target": 0.1, "effort": 14.0},
            0.0,
            0.0,
            {"position_target": 0.0, "effort": 10.0},
            ("predicted_effort",),
        ),
        # A velocity target of 4 at rest: 5 x 4 = 20, so 2 rad/s are left.
        ({"damping": 5.0, "velocity_target": 4.0}, 0.0, 0.0, {"velocity_target": 2.0}, ("predicted_effort",)),
        # 5 (1 + 4) = 25: the velocity target goes, and 5 x 4 = 20 of braking to 2.5 x 4.
        (
            {"damping": 5.0, "velocity_target": 1.0},
            0.0,
            -4.0,
            {"velocity_target": 0.0, "damping": 2.5},
            ("predicted_effort", "gains"),
        ),
        # Braking alone, 5 (0 - 4) = -20: the velocity target stays 0, kd halves.
        ({"damping": 5.0}, 0.0, 4.0, {"damping": 2.5}, ("predicted_effort", "gains")),
        # A spring that pulls against the braking is left alone: -20 + 6 = -14, so kd (0 - 4) = -16.
        (
            {"damping": 5.0, "stiffness": 20.0, "position_target": 0.3},
            0.0,
            4.0,
            {"damping": 4.0},
            ("predicted_effort", "gains"),
        ),
        # A velocity target against the braking, too: 5 (-1 + 4) = 15, and 10/3 (-1 + 4) = 10.
        (
            {"damping": 5.0, "velocity_target": -1.0},
            0.0,
            -4.0,
            {"damping": 10.0 / 3.0},
            ("predicted_effort", "gains"),
        ),
        # The joint at 2.0 is outside -1..1: the target cannot follow it further than 1, so kp pays:
        # 20 (1 - 2) = -20 becomes 10 (1 - 2).
        (
            {"stiffness": 20.0, "position_target": -0.5},
            2.0,
            0.0,
            {"position_target": 1.0, "stiffness": 10.0},
            ("predicted_effort", "gains"),
        ),
        # Stiffness pays before damping: -20 of spring and -5 of braking leave -5 of spring.
        (
            {"stiffness": 20.0, "damping": 1.0, "position_target": 1.0},
            2.0,
            5.0,
            {"stiffness": 5.0},
            ("predicted_effort", "gains"),
        ),
    ],
)
def test_effort_is_kept_by_hand_computed_amounts(
    requested: dict[str, float], q: float, dq: float, expected: dict[str, float], names: tuple[str, ...]
) -> None:
    """What pushes too far pays in the stated order; everything else stays exactly what it was."""
    before = command(**requested)
    after, clipped = keep(before, q, dq, low=-1.0, high=1.0)
    assert clipped == names
    for field in dataclasses.fields(JointCommand):
        value = float(getattr(after, field.name)[0])
        if field.name in expected:
            assert value == pytest.approx(expected[field.name], rel=1e-8, abs=1e-8)
        else:
            assert value == getattr(before, field.name)[0]
    assert abs(effort(after, np.array([q]), np.array([dq]))[0]) <= 10.0


def test_each_joint_pays_for_itself() -> None:
    """One joint over its limit does not change another, whatever their order."""
    requested = command(
        position_target=[0.9, 0.1, -0.9],
        stiffness=[20.0] * 3,
        damping=[1.0] * 3,
        velocity_target=[0.0] * 3,
        effort=[0.0] * 3,
        effort_limit=[8.0] * 3,
        speed_limit=[3.0] * 3,
    )
    zeros, span = np.zeros(3), (np.full(3, -1.0), np.full(3, 1.0))
    after, clipped = keep_effort(requested, zeros, zeros, np.array([10.0, 10.0, 8.0]), span)
    np.testing.assert_allclose(after.position_target, [0.5, 0.1, -0.4], rtol=1e-8)
    assert after.position_target[1] == 0.1
    assert clipped == ("predicted_effort",)


def test_gains_of_any_joint_are_named() -> None:
    """One lowered gain among many is enough for its name."""
    for kp, kd, q, dq in (([20.0, 20.0], [0.0, 0.0], 2.0, 0.0), ([0.0, 0.0], [5.0, 5.0], 0.0, 4.0)):
        requested = command(
            position_target=[0.0, 0.0],
            stiffness=kp,
            damping=kd,
            velocity_target=[0.0] * 2,
            effort=[0.0] * 2,
            effort_limit=[8.0] * 2,
            speed_limit=[3.0] * 2,
        )
        span = (np.full(2, -1.0), np.full(2, 1.0))
        position, velocity = np.array([0.0, q]), np.array([0.0, dq])
        assert keep_effort(requested, position, velocity, np.full(2, 10.0), span)[1] == (
            "predicted_effort",
            "gains",
        )


def test_an_infinite_limit_changes_nothing() -> None:
    """A joint may be left without a limit beside one that has one."""
    requested = command(
        position_target=[0.9, 0.9],
        stiffness=[20.0] * 2,
        damping=[1.0] * 2,
        velocity_target=[0.0] * 2,
        effort=[0.0] * 2,
        effort_limit=[8.0] * 2,
        speed_limit=[3.0] * 2,
    )
    span = (np.full(2, -1.0), np.full(2, 1.0))
    after, clipped = keep_effort(requested, np.zeros(2), np.zeros(2), np.array([math.inf, 10.0]), span)
    np.testing.assert_allclose(after.position_target, [0.9, 0.5], rtol=1e-8)
    assert clipped == ("predicted_effort",)


def around(limit: float) -> list[float]:
    """Values dense around a limit and sparse elsewhere."""
    near = [limit + k * 10.0**-e for e in (6, 4, 2) for k in (-1, 1)]
    return [*near, limit, 0.0, 0.5 * limit, 2.0 * limit, 5.0 * limit]


@pytest.mark.parametrize("target", [*around(0.5), *around(-0.5)])
def test_the_boundary_is_the_limit_itself(target: float) -> None:
    """20 N·m/rad over 0.5 rad is 10 N·m: up to that nothing changes, beyond it the target stops there."""
    after, clipped = keep(command(stiffness=20.0, position_target=target), 0.0, 0.0)
    assert bool(clipped) is (abs(target) > 0.5)
    assert after.position_target[0] == pytest.approx(min(max(target, -0.5), 0.5), rel=1e-8)


SIZE = 3
number = st.floats(-30.0, 30.0)
gain = st.one_of(st.just(0.0), st.floats(1e-3, 200.0))


def vector(part: st.SearchStrategy[float]) -> st.SearchStrategy[FloatArray]:
    """Return arrays of one number a joint."""
    return st.lists(part, min_size=SIZE, max_size=SIZE).map(np.array)


@given(
    target=vector(st.floats(-1.0, 1.0)),
    rate=vector(number),
    kp=vector(gain),
    kd=vector(gain),
    push=vector(number),
    position=vector(st.floats(-3.0, 3.0)),
    velocity=vector(number),
    most=vector(st.floats(0.5, 50.0)),
)
@settings(deadline=None)
def test_effort_never_exceeds_its_limit_and_nothing_changes_sign(
    target: FloatArray,
    rate: FloatArray,
    kp: FloatArray,
    kd: FloatArray,
    push: FloatArray,
    position: FloatArray,
    velocity: FloatArray,
    most: FloatArray,
) -> None:
    """Whatever comes: effort and range hold, parts only shrink, and a good command passes untouched."""
    ones = np.ones(SIZE)
    requested = JointCommand(target, rate, kp, kd, push, ones, ones)
    made, names = keep_effort(requested, position, velocity, most, (-ones, ones))
    assert np.all(np.abs(effort(made, position, velocity)) <= most)
    assert np.all(np.abs(made.position_target) <= 1.0)
    assert np.all((0 <= made.stiffness) & (made.stiffness <= kp))
    assert np.all((0 <= made.damping) & (made.damping <= kd))
    # The target stays between the measured position and what was requested, as far as the range allows.
    inside = np.clip(position, -1.0, 1.0)
    low, high = np.minimum(inside, target), np.maximum(inside, target)
    assert np.all((low - 1e-12 <= made.position_target) & (made.position_target <= high + 1e-12))
    for before, after in ((rate, made.velocity_target), (push, made.effort)):
        assert np.all(after * before >= 0)
        assert np.all(np.abs(after) <= np.abs(before))
    good = np.abs(effort(requested, position, velocity)) <= most
    assert bool(names) is not bool(good.all())
    for field in dataclasses.fields(JointCommand):
        assert np.array_equal(getattr(made, field.name)[good], getattr(requested, field.name)[good])


# Inside the filter.


def test_the_filter_limits_effort_after_all_else() -> None:
    """Step and range cut the target to 0.25 first; 80 (0.25 - 0) - 8 x 0.5 = 16 N·m then leaves 0.175."""
    requested = command(position_target=0.9, stiffness=80.0, damping=8.0)
    made, clipped = SafetyFilter(LEGGED).clip(requested, np.zeros(1), np.zeros(1), np.array([0.5]))
    assert made.position_target[0] == pytest.approx(0.175, rel=1e-8)
    assert clipped == ("target_step", "target", "predicted_effort")


def test_the_filter_keeps_target_and_effort_of_a_joint_outside_its_range() -> None:
    """At 0.5, outside -0.25..0.25: the target stays at 0.25 and kp goes down to 10 / 0.25 = 40."""
    requested = command(position_target=0.0, stiffness=80.0)
    made, clipped = SafetyFilter(LEGGED).clip(requested, np.zeros(1), np.array([0.5]), np.zeros(1))
    assert made.position_target[0] == 0.25
    assert made.stiffness[0] == pytest.approx(40.0, rel=1e-8)
    assert clipped == ("predicted_effort", "gains")
    made, clipped = SafetyFilter(LEGGED).clip(requested, np.zeros(1), np.array([-0.5]), np.zeros(1))
    assert made.position_target[0] == -0.25
    assert made.stiffness[0] == pytest.approx(40.0, rel=1e-8)


def test_robots_without_legs_know_no_predicted_effort() -> None:
    """The same command passes where the description says nothing of it."""
    requested = command(position_target=0.25, stiffness=80.0)
    made, clipped = SafetyFilter(DESCRIPTION).clip(requested, np.zeros(1), np.zeros(1), np.zeros(1))
    assert (made.position_target[0], clipped) == (0.25, ())


@pytest.mark.parametrize(
    ("limit", "value", "accepted"),
    [
        (3.0, 3.0, True),
        (3.0, 4.0, True),
        (3.0, math.inf, False),
        (3.0, math.nan, False),
        (math.inf, 3.0, True),
        (math.inf, math.inf, True),
        (math.inf, -math.inf, False),
        (math.inf, math.nan, False),
    ],
)
@pytest.mark.parametrize("field", ["speed", "effort"])
def test_limits_of_speed_and_effort_may_be_infinite_where_the_robot_has_none(
    field: str, limit: float, value: float, accepted: bool
) -> None:
    """A robot without set-point generator, or without a force limit, says so, and so do its commands."""
    changed: dict[str, Any] = {field: (limit,)}
    limits = dataclasses.replace(DESCRIPTION.limits, **changed)
    gate = SafetyFilter(dataclasses.replace(DESCRIPTION, limits=limits))
    asked = command(**{f"{field}_limit": value})
    assert gate.accepts(asked) is accepted
    assert is_finite(asked) is math.isfinite(value)


@pytest.mark.parametrize(
    "field", [f.name for f in dataclasses.fields(JointCommand) if f.name != "speed_limit"]
)
def test_every_other_field_must_be_finite(field: str) -> None:
    """An infinite speed limit excuses nothing else."""
    limits = dataclasses.replace(DESCRIPTION.limits, speed=(math.inf,))
    gate = SafetyFilter(dataclasses.replace(DESCRIPTION, limits=limits))
    assert not gate.accepts(command(**{"speed_limit": math.inf, field: math.nan}))
    assert not gate.accepts(command(**{"speed_limit": math.inf, field: math.inf}))
