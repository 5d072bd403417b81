"""Fault tables: what counts as a repetition, and one column for each wire."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fault_rig import ENDING, RUNNING, Case, SpoiledError
from fault_table import complaints, page
from measure_arm_faults import ARMED, IDLE, ArmRig
from measure_go2_faults import Go2Rig
from measure_ros2_faults import FOREIGN, Ros2Rig

from deal_hw.drivers.ros2.command_log import AGAIN

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


@pytest.mark.parametrize(
    ("phase", "fault_ns", "fine"),
    [
        # The motors were idle before the fault: the run had ended, and its exit code stays.
        (ENDING, 250, True),
        # They obeyed: a run whose control process stood still must not end as finished.
        (ENDING, 150, False),
        (RUNNING, 250, False),
    ],
)
def test_a_fault_after_the_end_leaves_the_exit_code(
    tmp_path: Path, phase: str, fault_ns: int, fine: bool
) -> None:
    """By the emulator's log, not by the run's own report."""
    rig = ArmRig(Case(name="x", codes=(2,)), "dynamixel", tmp_path, np.random.default_rng(0))
    rig.phase, rig.fault_ns, rig.run = phase, fault_ns, argparse.Namespace(returncode=0)  # type: ignore[assignment]
    report = {"changes": [[0, 100, ARMED], [0, 200, IDLE]]}
    assert complaints(rig, report, {"dataset": "whole"}) == ([] if fine else ["exit code 0"])


def test_no_run_follows_a_run_that_never_commanded(tmp_path: Path) -> None:
    """The emulator's fault begins after the first command: it would be awaited in vain."""
    rig = ArmRig(Case(name="x", again=True), "dynamixel", tmp_path, np.random.default_rng(0))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run").write_text("deal-hw: error: no states\n")
    rig.events = [(1, "sound")]
    with pytest.raises(SpoiledError, match="ended before it commanded: deal-hw: error: no states"):
        rig.run_again()


def test_speeds_and_the_held_pose_are_judged(tmp_path: Path) -> None:
    """A run that holds a pose far from the joints, or begins faster than homing, is not as expected."""
    rig = Ros2Rig(Case(name="x", again=True), "dds", tmp_path, np.random.default_rng(0))
    rig.fault_ns, rig.end_ns = 100, 400
    report: dict[str, Any] = {
        "commands": [
            [90, [0.1, 0.0], 0.01],
            [110, [0.2, 0.0], 0.02],
            [120, [0.2, 0.0], 0.03],
            [130, list(FOREIGN), 2.0],
            [500, [0.2, 0.0], 0.9],
        ],
        "fastest_after": [[0, 90, "first command", 0.4], [0, 500, AGAIN, 0.8], [0, 300, "sound", 3.0]],
    }
    assert rig.states(report) == [(110, True), (110, False)]
    assert set(rig.figures(report).values()) == {0.02, 0.4, 0.8, 3.0}
    assert rig.notes == ["the next run begins at 0.80 rad/s"]
    report["commands"][1][2] = 0.4
    rig.figures(report)
    assert "it holds a pose 0.40 rad away" in rig.notes
