"""Where a walking policy gets its wanted velocity from."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.errors import ConfigurationError
from deal_hw.motions.velocity import (
    FASTEST,
    HEADING_TURN,
    KEY_LIFE_S,
    KEYS,
    LARGEST,
    FixedVelocity,
    HeldHeading,
    KeyboardVelocity,
    RemoteVelocity,
    limited_axes,
    make_source,
)
from deal_hw.types import BodyState, RobotState, Status


def state(sticks: tuple[float, float, float, float] | None = None, heading: float = 0.0) -> RobotState:
    """A state of a robot with one joint and, where sticks are given, a body with a heading [rad]."""
    body = None
    if sticks is not None:
        body = BodyState(
            orientation=np.array([math.cos(heading / 2), 0, 0, math.sin(heading / 2)]),
            angular_velocity=np.zeros(3),
            acceleration=np.zeros(3),
            foot_force=np.zeros(4),
            temperature=np.zeros(1),
            lost=np.zeros(1, dtype=np.int64),
            battery=0.5,
            voltage=28.0,
            current=1.0,
            sticks=np.array(sticks),
            buttons=0,
        )
    zeros = np.zeros(1)
    return RobotState(zeros, zeros, zeros, 0, 0, 0, -1, -1, Status.NONE, body)


def test_three_numbers_are_a_fixed_velocity() -> None:
    """The text's numbers come back at any time."""
    source = make_source("0.3,-0.1,0.5")
    for time_s in (0.0, 100.0):
        np.testing.assert_array_equal(source.velocity(state(), time_s), [0.3, -0.1, 0.5])


@pytest.mark.parametrize("text", ["", "0.3,0", "0,0,0,0", "fast", "nan,0,0", "2,0,0", "0,-0.6,0"])
def test_wrong_texts_are_refused(text: str) -> None:
    """What is not three numbers inside the limits says what is allowed."""
    with pytest.raises(ConfigurationError, match=r"0\.3,0,0|allowed"):
        make_source(text)


@given(st.tuples(*[st.floats(allow_nan=True)] * 3))
def test_a_fixed_velocity_is_inside_the_limits_or_refused(velocity: tuple[float, float, float]) -> None:
    """Exactly the velocities inside the limits are taken."""
    inside = all(abs(v) <= most for v, most in zip(velocity, FASTEST, strict=True))
    if inside:
        np.testing.assert_array_equal(FixedVelocity(velocity).velocity(state(), 0.0), velocity)
    else:
        with pytest.raises(ConfigurationError, match="allowed"):
            FixedVelocity(velocity)


def test_a_script_holds_each_line_until_the_next(tmp_path: Path) -> None:
    """Zero before the first time, then the line whose time has come last."""
    path = tmp_path / "walk.csv"
    path.write_text("time_s,x,y,yaw\n1,0.5,0,0\n2.5,0,0,-0.4\n")
    source = make_source(str(path))
    for time_s, expected in ((0.99, (0, 0, 0)), (1.0, (0.5, 0, 0)), (2.49, (0.5, 0, 0)), (9.0, (0, 0, -0.4))):
        np.testing.assert_array_equal(source.velocity(state(), time_s), expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "first line"),
        ("t,x,y,yaw\n", "first line"),
        ("time_s,x,y,yaw\n", "no line"),
        ("time_s,x,y,yaw\n0,1,0\n", "line 2"),
        ("time_s,x,y,yaw\n0,a,0,0\n", "line 2"),
        ("time_s,x,y,yaw\n1,0,0,0\n1,0,0,0\n", "line 3"),
        ("time_s,x,y,yaw\n0,9,0,0\n", "line 2"),
        ("time_s,x,y,yaw\nnan,0,0,0\n", "line 2"),
        ("time_s,x,y,yaw\n\n\n0,9,0,0\n", "line 4"),
        ("time_s,x,y,yaw\n\n0,0,0,0\n\n0,0,0,0\n", "line 5"),
    ],
)
def test_a_wrong_script_names_its_line(tmp_path: Path, text: str, words: str) -> None:
    """The message says where the mistake is."""
    path = tmp_path / "walk.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=words):
        make_source(str(path))


def test_a_missing_script_is_named(tmp_path: Path) -> None:
    """A path without a file is an error that names it."""
    with pytest.raises(ConfigurationError, match=r"nowhere\.csv"):
        make_source(str(tmp_path / "nowhere.csv"))


def test_the_sticks_give_the_velocity() -> None:
    """Left stick up is ahead, left is left, right stick to the left turns left, all at the limits."""
    source = RemoteVelocity()
    np.testing.assert_allclose(source.velocity(state((-1.0, 1.0, -1.0, 0.3)), 0.0), LARGEST)
    # A twentieth of the way is the dead zone: 0.04 counts as nothing, 0.5 of 1 m/s ahead is half a metre.
    np.testing.assert_allclose(source.velocity(state((0.04, 0.5, 0.0, 0.0)), 0.0), [0.5, 0.0, 0.0])


@pytest.mark.parametrize("sticks", [None, (math.nan, 0.0, 0.0, 0.0)])
def test_without_a_remote_the_robot_stands(sticks: tuple[float, float, float, float] | None) -> None:
    """No body and no number both ask for nothing."""
    np.testing.assert_array_equal(RemoteVelocity().velocity(state(sticks), 0.0), np.zeros(3))


def test_what_a_policy_was_not_trained_for_is_told(tmp_path: Path) -> None:
    """Each axis that the source may ask more of than the policy's range, with both ranges."""
    trained = ((-0.6, 1.0), (-0.5, 0.5), (-1.0, 1.0))
    script = tmp_path / "walk.csv"
    script.write_text("time_s,x,y,yaw\n0,0.5,0,0\n1,-0.8,0.1,0\n")
    reported = ["x -0.8 to 0.5, limited to -0.6 to 1"]
    assert limited_axes(make_source(str(script)), trained) == reported
    assert limited_axes(make_source("remote"), trained) == ["x -1 to 1, limited to -0.6 to 1"]
    assert limited_axes(make_source("1,0.5,-1"), trained) == []
    assert limited_axes(make_source("-1,0,0"), trained) == ["x -1, limited to -0.6 to 1"]
    assert limited_axes(make_source("keyboard"), trained) == []
    assert limited_axes(make_source("keyboard"), ((0.0, 1.0), (-0.5, 0.5), (0.0, 0.0))) == [
        "x -0.5 to 0.5, limited to 0 to 1",
        "yaw -0.6 to 0.6, limited to 0 to 0",
    ]
    # A policy that notes no range is not limited.
    assert limited_axes(make_source("1,0,0"), ()) == []


def test_a_key_counts_while_it_is_held() -> None:
    """A key's velocity lasts for its life after the last press; unknown keys change nothing."""
    source = make_source("keyboard")
    if not isinstance(source, KeyboardVelocity):
        raise TypeError("make_source('keyboard') made something else")
    source.velocity(state(), 1.0)
    source.press("w")
    source.press("?")
    np.testing.assert_array_equal(source.velocity(state(), 0.99 + KEY_LIFE_S), KEYS["w"])
    np.testing.assert_array_equal(source.velocity(state(), 1.01 + KEY_LIFE_S), np.zeros(3))


def test_a_key_from_before_the_walk_does_not_count() -> None:
    """While the robot stands up nobody asks for a velocity, and a key pressed then must not start it off."""
    source = KeyboardVelocity()
    source.press("w")
    np.testing.assert_array_equal(source.velocity(state(), 0.0), np.zeros(3))
    source.press("a")
    np.testing.assert_array_equal(source.velocity(state(), 0.02), KEYS["a"])


REST = (0.0, 0.0, 0.0, 0.0)


def test_a_held_heading_is_where_the_yaw_rates_lead() -> None:
    """By hand: 0.2 rad/s for 0.5 s from 3.1 rad; the base is 0.05 rad short, also across half a turn."""
    source = HeldHeading(FixedVelocity((0.4, 0.1, 0.2)), gain=1.0)
    np.testing.assert_allclose(source.velocity(state(REST, 3.1), 2.0), [0.4, 0.1, 0.2])
    for tick in range(1, 25):
        source.velocity(state(REST, 3.1 + 0.2 * 0.02 * tick), 2.0 + 0.02 * tick)
    wanted = 3.1 + 0.2 * 0.5
    assert wanted > math.pi
    found = source.velocity(state(REST, wanted - 0.05), 2.5)
    np.testing.assert_allclose(found, [0.4, 0.1, 0.2 + 0.05], atol=1e-9)
    # A large error is corrected slowly.
    np.testing.assert_allclose(
        source.velocity(state(REST, wanted - 2.0), 2.5), [0.4, 0.1, 0.2 + HEADING_TURN]
    )


def test_a_robot_that_stands_may_be_turned_by_hand() -> None:
    """Standing forgets the heading; a robot without an inertial sensor gets what was requested."""
    velocity = [0.5, 0.0, 0.0]

    class Source:
        def velocity(self, state: RobotState, time_s: float) -> np.ndarray:
            return np.array(velocity)

    source = HeldHeading(Source(), gain=1.0)
    source.velocity(state(REST, 0.0), 0.0)
    np.testing.assert_allclose(source.velocity(state(REST, 0.1), 0.02), [0.5, 0.0, -0.1])
    velocity[0] = 0.0
    np.testing.assert_array_equal(source.velocity(state(REST, 1.0), 0.04), np.zeros(3))
    velocity[0] = 0.5
    np.testing.assert_array_equal(source.velocity(state(REST, 1.0), 0.06), [0.5, 0.0, 0.0])
    np.testing.assert_array_equal(source.velocity(state(), 0.08), [0.5, 0.0, 0.0])
