"""How well a robot followed its commands, from where its base was."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.motions.planned_end import ENDING_EVENT
from deal_hw.motions.scores.velocity_error import (
    VELOCITY_EVENT,
    Track,
    VelocityErrorSettings,
    Wanted,
    velocity_data,
    velocity_error,
    wanted_in,
)
from deal_hw.types import Event

SECOND_NS = 10**9


def driven(ahead: float, turn: float, seconds: float = 6.0, heading: float = 0.7) -> Track:
    """Return the track of a base that keeps its velocity ahead [m/s] and its yaw rate [rad/s]."""
    time_s = np.arange(0.0, seconds, 0.002)
    angle = heading + turn * time_s
    place = np.cumsum(0.002 * ahead * np.stack((np.cos(angle), np.sin(angle)), axis=1), axis=0)
    return Track(time_s, place, np.angle(np.exp(1j * angle)))


def reported(*velocities: tuple[float, float, float], every_s: float = 3.0) -> Wanted:
    """Return velocities that are wanted one after the other."""
    times = every_s * np.arange(len(velocities), dtype=np.float64)
    return Wanted(times, np.array(velocities), every_s * len(velocities))


@pytest.mark.parametrize(("ahead", "turn"), [(0.8, 0.0), (0.5, 0.9), (0.0, -1.0)])
def test_who_does_what_is_wanted_makes_no_error(ahead: float, turn: float) -> None:
    """Ahead and turning, whatever the heading; headings that wrap are no jump."""
    error = velocity_error(driven(ahead, turn), reported((ahead, 0.0, turn), every_s=6.0))
    assert error is not None
    assert error.velocity_m_s == pytest.approx(0.0, abs=5e-3)
    assert error.yaw_rad_s == pytest.approx(0.0, abs=1e-9)
    (part,) = error.parts.values()
    assert part[2:] == pytest.approx([ahead, 0.0, turn], abs=5e-3)


def test_errors_are_those_of_each_part_after_it_has_settled() -> None:
    """Told 1 m/s ahead, then 1 m/s to the left, a base that goes 0.8 m/s ahead is off by 0.2 and 1.28."""
    error = velocity_error(driven(0.8, 0.1), reported((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    assert error is not None
    assert error.parts["1,0,0"][0] == pytest.approx(0.2, abs=0.01)
    assert error.parts["0,1,0"][0] == pytest.approx(np.hypot(0.8, 1.0), abs=0.01)
    assert error.yaw_rad_s == pytest.approx(0.1, abs=1e-9)
    # Two parts of 3 s, without the first second and the last step of each.
    assert error.seconds == pytest.approx(2 * (3.0 - 1.0 - 0.4), abs=0.05)


def test_standing_is_no_walk() -> None:
    """Its error stands among the parts, and no second of walking was judged."""
    error = velocity_error(driven(0.1, 0.0), reported((0.0, 0.0, 0.0), every_s=6.0))
    assert error is not None
    assert error.seconds == 0.0
    assert error.parts["0,0,0"][0] == pytest.approx(0.1, abs=1e-3)


def test_velocities_that_change_too_often_are_not_judged() -> None:
    """A second after each change nothing is left of a part of 1.2 s."""
    wanted = reported((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (1.0, 0.0, 0.0), every_s=1.2)
    assert velocity_error(driven(1.0, 0.0), wanted) is None
    less = VelocityErrorSettings(settle_s=0.2)
    assert velocity_error(driven(1.0, 0.0), wanted, less) is not None


def test_events_tell_what_was_wanted_and_when() -> None:
    """In order, on the recording's time; a recording without them tells nothing."""
    events = [
        Event(5 * SECOND_NS, VELOCITY_EVENT, "", velocity_data(np.array([1.0, 0.0, 0.0]))),
        Event(6 * SECOND_NS, "warning", "something else"),
        Event(7 * SECOND_NS, VELOCITY_EVENT, "", velocity_data(np.array([0.0, 0.5, -1.0]))),
    ]
    wanted = wanted_in(events, 2 * SECOND_NS, 10.0)
    assert wanted is not None
    np.testing.assert_allclose(wanted.time_s, [3.0, 5.0])
    np.testing.assert_array_equal(wanted.velocity, [[1.0, 0.0, 0.0], [0.0, 0.5, -1.0]])
    assert wanted.end_s == 13.0
    assert wanted_in(events[1:2], 0, 10.0) is None


def test_a_planned_end_cuts_the_requested_velocities() -> None:
    """It comes 4 s after the walk began, which was to last 10 s: slowing down is no part of the walk."""
    events = [
        Event(5 * SECOND_NS, VELOCITY_EVENT, "", velocity_data(np.array([1.0, 0.0, 0.0]))),
        Event(9 * SECOND_NS, ENDING_EVENT, "ended by the operator's key", {}),
        Event(10 * SECOND_NS, ENDING_EVENT, "it comes to its default pose", {}),
    ]
    wanted = wanted_in(events, 2 * SECOND_NS, 10.0)
    assert wanted is not None
    assert wanted.end_s == pytest.approx(7.0)
    late = wanted_in([events[0]], 2 * SECOND_NS, 10.0)
    assert late is not None
    assert late.end_s == pytest.approx(13.0)
