"""The table of times until `deal-hw stop` has made a robot passive."""

from __future__ import annotations

from typing import Any

from measure_stop import SUBJECTS, table

from deal_hw.robots import robot_entry


def row(state: str, passive_ms: float | None, **more: Any) -> dict[str, Any]:
    """Return a row of a Go2."""
    kind = {"robot": "go2-dds", "state": state, "busy": 0, "same_session": False, "error": ""}
    return {**kind, "passive": True, "passive_ms": passive_ms, **more}


def test_the_table_has_median_and_longest_time() -> None:
    """By robot and state; failed repetitions are left out, those that did not become passive are counted."""
    rows = [
        *(row("healthy", ms) for ms in (300.0, 100.0, 220.0)),
        row("healthy", None, error="TimeoutError: no run began"),
        row("both-stopped", 500.0, busy=16),
        row("both-stopped", None, busy=16, passive=False),
        row("both-stopped", None, busy=16, same_session=True),
    ]
    assert table(rows).splitlines() == [
        "| robot | healthy | both-stopped, 16 busy | both-stopped, 16 busy, same session |",
        "|---|---|---|---|",
        "| go2-dds | 0.22 / 0.30 | 0.50 / 0.50 (1 of 2) | before |",
    ]


def test_each_subject_is_a_robot_with_a_driver() -> None:
    """Or one that a robot.yaml describes."""
    for name, subject in SUBJECTS.items():
        assert bool(subject.robot) != bool(subject.file), name
        if subject.robot:
            assert subject.wire in ("", *(wire.name for wire in robot_entry(subject.robot).wires)), name
