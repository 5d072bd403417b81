"""Fault tables: what counts as a repetition, and one column for each wire."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_rig import RUNNING, Case, SpoiledError
from fault_table import page
from measure_go2_faults import Go2Rig

pytestmark = pytest.mark.real_time


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


def test_a_run_that_never_reaches_its_phase_is_no_repetition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a starved machine it did not stand within 40 s: no fault was caused, and none may be judged."""
    rig = Go2Rig(Case(name="x", phases=(RUNNING,)), "zenoh", tmp_path, np.random.default_rng(0))

    def until(*_: Any) -> None:
        raise TimeoutError("waited 40 s without result")

    monkeypatch.setattr(rig, "until", until)
    with pytest.raises(SpoiledError, match="did not reach its phase 'running': waited 40 s"):
        rig.await_moment()
