"""Pages of fault tables: one column for each wire."""

from __future__ import annotations

from typing import Any

from fault_table import page


def result(wire: str, fault: str, passive_ms: float) -> dict[str, Any]:
    """Return a file of one row with one repetition."""
    repetition = {
        "phase": "running",
        "exit_code": 130,
        "dataset": "whole",
        "obeyed": True,
        "passive_ms": passive_ms,
        "pause_ms": 0.0,
        "operator": "stopped: x",
        "complaints": [],
    }
    row = {
        "fault": fault,
        "wire": wire,
        "expected": "passive",
        "load": [1.0, 2.0],
        "repetitions": [repetition],
    }
    return {"calls": [{"machine": {"platform": "Linux", "processors": 2}}], "rows": [row]}


def test_files_of_one_wire_share_its_column() -> None:
    """Twenty repetitions of some faults and one of others may lie in two files."""
    text = page("t", (), [result("zenoh", "a", 3.0), result("dds", "a", 4.0), result("zenoh", "b", 5.0)])
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert lines[0].startswith("| fault | expected | zenoh [ms] | dds [ms] | exit codes |")
    assert lines[2].startswith("| a | passive | 3 / 3; 1/1 | 4 / 4; 1/1 | 130 |")
    assert lines[3].startswith("| b | passive | 5 / 5; 1/1 |  | 130 |")
    assert text.endswith("Not as expected: none.\n")
