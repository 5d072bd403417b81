"""The judge of a run with a fault finds what is wrong with a robot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from deal_hw.testing.fault_rows import FAULTS, PHASES, RUNNING, Expected, FaultTable, Lacks
from deal_hw.testing.fault_run import FaultEvidence, complaints

SECOND = 10**9
TABLE = FaultTable(
    name="toy",
    stiff=lambda device: True,
    start_speed=0.5,
    phases={"planned end": Lacks("it stands")},
    rows={fault: Lacks("a toy") for fault in FAULTS[-6:]},
)
CELL = Expected(end="passive", within_s=0.2)
GOOD = FaultEvidence(
    phase=RUNNING,
    fault_ns=10 * SECOND,
    return_ns=12 * SECOND,
    first_ns=9 * SECOND,
    last_ns=10 * SECOND + SECOND // 10,
    end_ns=14 * SECOND,
    outcome="tripped",
    confirmed=True,
    next_outcome="stopped",
    next_began=True,
    next_speed=0.6,
)


def judged(cell: Expected = CELL, **changed: Any) -> str:
    """Return what is wrong with a run that differs from a good one."""
    return "; ".join(complaints(replace(GOOD, **changed), RUNNING, cell, TABLE))


def test_a_robot_that_may_fall_may_be_refused() -> None:
    """It may lie on its side; if the next run begins, it is judged as any other."""
    falls = replace(TABLE, may_fall=True)
    refused, fast = replace(GOOD, next_began=False, next_reason="it leans"), replace(GOOD, next_speed=2.0)
    assert complaints(refused, RUNNING, CELL, falls) == []
    assert complaints(fast, RUNNING, CELL, falls) == ["the next run begins with 2.00 rad/s or m/s"]


def test_a_single_cell_may_differ_from_its_row() -> None:
    """The others of the row stay, and a table without the cell too."""
    differs = replace(TABLE, cells={(FAULTS[0], RUNNING): Expected(end="goes on", why="a toy")})
    before, after = TABLE.combinations(), differs.combinations()
    assert {what for what in before if before[what] != after[what]} == {(FAULTS[0], RUNNING)}
    assert after[FAULTS[0], RUNNING] == Expected(end="goes on", why="a toy")


def test_a_robot_that_is_passive_in_time_is_right() -> None:
    """Nothing is complained about."""
    assert judged() == ""


@pytest.mark.parametrize(
    ("changed", "seen"),
    [
        ({"last_ns": 10 * SECOND + SECOND // 2}, "after the fault the drives followed commands for 0.50 s"),
        ({"last_ns": 14 * SECOND}, "the drives still follow commands"),
        ({"outcome": "finished"}, "the run finished"),
        ({"after_return": 2.0}, "after the fault's end a joint is driven at 2.00 rad/s"),
        ({"off_target": 0.5}, "the held pose is 0.50 rad or m from the true one"),
        ({"next_speed": 2.0}, "the next run begins with 2.00 rad/s"),
        ({"next_began": False, "next_reason": "refused"}, "the next run does not begin: refused"),
        ({"phase": "homing"}, "the fault came in the phase 'homing'"),
        ({"fault_ns": -1, "reason": "no state"}, "the run did not come to the phase 'running'"),
    ],
)
def test_what_is_wrong_is_named(changed: dict[str, Any], seen: str) -> None:
    """Each thing by itself."""
    assert seen in judged(**changed)


def test_limbs_that_still_fall_may_be_caught() -> None:
    """The next run is no faster than what it found."""
    assert judged(next_speed=0.9, next_fall=0.8) == ""


@pytest.mark.parametrize(
    ("end", "changed", "seen"),
    [
        ("untouched", {}, "the drives followed commands"),
        ("holds", {"last_ns": 9 * SECOND}, "the drives do not hold the last command"),
        ("goes on", {"reason": "it fell"}, "the run did not finish: it fell"),
    ],
)
def test_other_ends_are_judged(end: Any, changed: dict[str, Any], seen: str) -> None:
    """Untouched, held and finished runs."""
    assert seen in judged(Expected(end=end), **changed)


def test_a_table_has_every_combination() -> None:
    """Of a phase or a row that the robot lacks the reason stands in each cell."""
    cells = TABLE.combinations()
    assert set(cells) == {(fault, phase) for fault in FAULTS for phase in PHASES}
    assert cells[FAULTS[0], "planned end"] == Lacks("it stands")
    assert cells[FAULTS[-1], RUNNING] == Lacks("a toy")
    assert cells[FAULTS[0], RUNNING] == Expected(end="passive", within_s=0.15)
