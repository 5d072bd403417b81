"""How strong to record next: what counts as motion, what a step changes, when the search ends."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.control.safety.filter import SafetyFilter
from deal_hw.data.recording.excitation import Excitation
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig, Segment
from deal_hw.motions.excitation.level import (
    HIGHEST_LEVEL,
    LOWEST_LEVEL,
    ExcitationLevelSearch,
    shortfalls,
    with_excitation_level,
)
from deal_hw.types import RobotState, Status

AT_REST = RobotState(np.zeros(2), np.zeros(2), np.zeros(2), 0, 0, 0, -1, -1, Status.ARMED)
STILL = ("pole moved 0.01 rad",)


def moved(cart: float, pole: float, asked: float) -> Excitation:
    """Return what a recording says of cart [m], pole [rad] and targets [m]."""
    nothing = (0.0, 0.0)
    return Excitation(4.0, (cart, pole), nothing, nothing, (0, 0), (asked,), (20,))


@pytest.mark.parametrize(
    ("cart", "pole", "asked", "words"),
    [
        # 30 % of 0.24 m is 0.072 m. The pole's noise is sqrt(2^2 + (2 pi / 4096 * 1000)^2 / 12) = 2.05 mrad.
        (0.073, 0.21, 0.24, ()),
        (0.071, 0.21, 0.24, ("cart moved 0.071 m, less than 0.072 m (30% of the commanded range)",)),
        (0.073, 0.20, 0.24, ("pole moved 0.2 rad, less than 0.2 rad (100 times the sensor's noise)",)),
        # 20 times sqrt(0.3^2 + 0.5^2 / 12) mm is 6.7 mm: of a cart that was hardly asked at all.
        (0.006, 3.0, 0.01, ("cart moved 0.006 m, less than 0.0067 m (20 times the sensor's noise)",)),
    ],
)
def test_what_hardly_moves_is_named(cart: float, pole: float, asked: float, words: tuple[str, ...]) -> None:
    """A driven joint is measured by what was asked of it, one without a motor by its sensor."""
    assert shortfalls(moved(cart, pole, asked), DESCRIPTION) == words


def test_a_step_up_by_hand() -> None:
    """0.12 m becomes 0.18; 80 N/m 128, 8 N s/m 4, 4 N 8, 1 m/s 1.5; a limit sent low stays low."""
    up = with_excitation_level(RichConfig(), 1, DESCRIPTION)
    assert [up.amplitude, up.balance_s] == pytest.approx([0.18, 0.3])
    assert list(up.hold_s) == pytest.approx([0.15, 0.45])
    assert up.segments[-1] == Segment(
        start=0.0, stop=1.0, stiffness=1.6, damping=0.5, effort_limit=2.0, speed_limit=1.5
    )
    low = up.segments[0]
    # 2.5 times 80 N/m is what may be sent at most, and so are 3 m/s.
    assert (low.stiffness, low.damping, low.effort_limit, low.speed_limit) == (2.5, 0.25, 0.15, 3.0)
    # What creeps asks for little effort: the lowest limit is halved.
    assert up.segments[1].effort_limit == 0.025
    # What still does not move is held by friction: 8 times 0.15 and 8 times half of 0.05.
    held = with_excitation_level(RichConfig(), 2, DESCRIPTION).segments
    assert [part.effort_limit for part in held] == pytest.approx([1.2, 0.2, 2.0])


def test_steps_down_are_slower_and_nearer() -> None:
    """0.12 m becomes 0.6 * 0.12, the speed half, the damping half again as much."""
    down = with_excitation_level(RichConfig(), -1, DESCRIPTION)
    assert down.amplitude == pytest.approx(0.072)
    last = down.segments[-1]
    assert (last.stiffness, last.damping, last.effort_limit, last.speed_limit) == (0.8, 1.5, 0.7, 0.5)
    assert with_excitation_level(RichConfig(), 0, DESCRIPTION) == RichConfig()


@given(excitation_level=st.floats(LOWEST_LEVEL, HIGHEST_LEVEL), seed=st.integers(0, 99))
def test_no_step_leaves_the_safety_limits(excitation_level: float, seed: int) -> None:
    """Whatever the excitation level, the safety filter finds nothing to clip but the way to a target."""
    config = dataclasses.replace(
        with_excitation_level(RichConfig(), excitation_level, DESCRIPTION), balance_s=0.0
    )
    behaviour = RichBehaviour(DESCRIPTION, None, config, seed)
    for k in range(0, 200, 7):
        command = behaviour.command(AT_REST, k / 50)
        clipped = SafetyFilter(DESCRIPTION).clip(command, command.position_target, np.zeros(1), np.zeros(1))[
            1
        ]
        assert clipped == ()


def test_a_still_robot_is_asked_for_more_until_the_limits() -> None:
    """0, 1, 2, 3, and then the words say that there is nothing more."""
    search = ExcitationLevelSearch()
    reported = [search.tell(STILL) for _ in range(4)]
    assert reported == [True, True, True, False]
    assert [a.level for a in search.attempts] == [0, 1, 2, 3]
    assert search.words == "it hardly moves: pole moved 0.01 rad; it is the strongest level"
    assert search.best == 3


def test_a_trip_is_followed_by_less_and_the_two_are_bisected() -> None:
    """Still at 0, a trip at 1: half a step, and where that hardly moves no finer one."""
    search = ExcitationLevelSearch()
    assert search.tell(STILL)
    assert search.tell((), "cart is at 0.4 m")
    assert (
        search.words == "the safety module ended it (cart is at 0.4 m); recording again, gentler "
        "(excitation level 0.5)"
    )
    assert not search.tell(STILL)
    assert search.words.endswith("half a step stronger was tried before")
    # The one that tripped moved, at least.
    assert search.attempts[search.best].level == 1
    again = ExcitationLevelSearch()
    assert again.tell((), "cart is at 0.4 m") and not again.tell(())
    assert (again.best, again.words) == (1, "")


def test_on_a_robot_nothing_follows_a_trip_by_itself() -> None:
    """A person looks first; the words say with what to go on."""
    search = ExcitationLevelSearch(rearm=False)
    assert not search.tell((), "cart is at 0.4 m")
    assert search.words.endswith("check the robot, then record again with --excitation-level -1")


def test_the_number_of_recordings_is_kept() -> None:
    """Two allowed, two made."""
    search = ExcitationLevelSearch(level=1, attempts=2)
    assert search.tell(STILL) and not search.tell(STILL)
    assert search.words.endswith("the number of recordings is used up; continue with --excitation-level 3")


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: ExcitationLevelSearch(level=4),
        lambda: ExcitationLevelSearch(attempts=0),
        lambda: with_excitation_level(RichConfig(), -3.5, DESCRIPTION),
    ],
)
def test_steps_that_there_are_not_are_refused(wrong: object) -> None:
    """The message says which there are."""
    with pytest.raises(ConfigurationError, match=r"-3 .*to 3|at least 1"):
        wrong()  # type: ignore[operator]
