"""The matrix of faults: counts, times and what is not as expected."""

from __future__ import annotations

from typing import Any

from fault_matrix import counts, measure, times, wrong
from virtual_fleet import fleet

from deal_hw.testing.fault_rows import DUPLICATE, RUNNING


def row(robot: str, phase: str, driven_s: float, **more: Any) -> dict[str, Any]:
    """Return a row of a cut cable."""
    return {
        "robot": robot,
        "fault": "cable cut and back",
        "phase": phase,
        "lacks": "",
        "expected": "passive",
        "since": "fault",
        "driven_s": driven_s,
        "error": "",
        **more,
    }


ROWS = [
    row("one", "homing", 0.1),
    row("one", "running", 0.25),
    row("one", "planned end", 0.0, lacks="it has no rest pose"),
    row("two", "running", 0.2),
    row("two", "running", 0.5, since="return", error="too late"),
    row("two", "homing", 9.0, expected="holds"),
]


def test_cells_are_counted_by_robot_and_phase() -> None:
    """What a robot lacks is counted apart."""
    assert counts(ROWS).splitlines()[2:] == [
        "| one | | 1 of 1 | | 1 of 1 | | | 2 of 2 | 1 |",
        "| two | | 1 of 1 | | 1 of 2 | | | 2 of 3 | 0 |",
        "| all | | 2 of 2 | | 2 of 3 | | | 4 of 5 | 1 |",
    ]


def test_the_longest_time_of_all_robots_is_given() -> None:
    """Times from the fault's end stand apart; drives that may hold have no time."""
    assert times(ROWS).splitlines()[2:] == [
        "| cable cut and back | | 0.10 | | 0.25, 0.50 after its end | | |"
    ]


def test_what_is_wrong_is_named() -> None:
    """A line each."""
    assert wrong(ROWS) == "two, cable cut and back, running: too late"


def test_what_a_robot_lacks_is_not_run() -> None:
    """The row has the reason."""
    assert measure(fleet()["go2"], DUPLICATE, RUNNING) == {
        "robot": "go2",
        "fault": DUPLICATE,
        "phase": RUNNING,
        "lacks": "its motors have no ids on a wire that deal-hw sees",
        "error": "",
    }
