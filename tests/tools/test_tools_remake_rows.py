"""Which stored rows `tools/remake_rows.py` makes again, by which command, and what it says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import remake_rows

Row = dict[str, Any]
ARGV = (
    *("deal-hw", "bench", "honest", "--task", "cartpole,ant", "--profile", "sensor", "--seeds", "0-9"),
    *("--methods", "eki,deal", "--xi", "20", "--population", "30", "--out", "old.json"),
)
"""An old command: the bench has another name today, one option is gone, and it made twenty rows."""


def row(**other: Any) -> Row:
    """Return a row of the bench `fixed-range`."""
    return {
        "bench": "fixed-range", "task": "cartpole", "space": "", "profile": "sensor", "seed": 0,
        "demonstration": "excite", "method": "eki", "refined": False, "range_ratio": 5.0, "error": "",
        "error_percent": 2.0, "log_error_x100": 2.0, "heldout_nrmse_calibrated": 0.01, "seconds": 10.0,
        **other,
    }  # fmt: skip


def stored(folder: Path, *rows: Row) -> Path:
    """Write a file of rows and return it."""
    path = folder / "stored.json"
    path.write_text(json.dumps({"format": "deal_hw.bench/1", "argv": list(ARGV), "rows": rows}))
    return path


def test_the_command_is_the_rows_own() -> None:
    words = remake_rows.command(row(task="ant", seed=0, refined=True), ARGV)
    assert words[:2] == ("bench", "fixed-range")
    text = " ".join(words)
    for given in ("--task ant", "--seeds 0", "--methods eki", "--population 30", "--range-ratio 5.0"):
        assert given in text
    assert "--refine-all" in words and "--xi" not in words and "--out" not in words
    assert "--space" not in words, "a field without a value is the bench's default"


@pytest.mark.parametrize(("fault", "given"), [("", "--faults none"), ("mass", "--faults mass")])
def test_a_robot_of_the_bench_verdict_is_named_with_its_fault(fault: str, given: str) -> None:
    words = remake_rows.command({"bench": "verdict", "task": "arm", "fault": fault, "seed": 2001}, ())
    assert " ".join(words).startswith(f"bench verdict --seeds 2001 --problems arm {given}")


def test_a_method_that_refines_by_itself_needs_no_option() -> None:
    assert "--refine-all" not in remake_rows.command(row(method="default", refined=True), ARGV)


def test_rows_are_of_different_methods_and_cheap(tmp_path: Path) -> None:
    path = stored(
        tmp_path,
        row(method="midpoint", seconds=0.1),
        row(method="eki", seed=1, seconds=30.0),
        row(method="eki", seed=2, seconds=20.0),
        row(method="deal", seconds=40.0),
    )
    found, _ = remake_rows.choose([path], 300, 3)
    assert [(one.stored["method"], one.stored["seed"]) for one in found] == [
        ("eki", 2),
        ("deal", 0),
        ("midpoint", 0),
    ]


def test_what_is_left_out_is_counted(tmp_path: Path) -> None:
    path = stored(
        tmp_path,
        row(),
        row(error="no motion"),
        row(seconds=301.0),
        row(checkpoint="a.onnx"),
        {"probe": "wire"},
    )
    found, left = remake_rows.choose([path], 300, 9)
    assert len(found) == 1
    assert sorted(left.values()) == [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("new", "verdict"),
    [
        (row(seconds=99.0), "same"),
        (row(error_percent=2.1), "agrees"),
        (row(error_percent=2.3), "LOSS"),
        (row(heldout_nrmse_calibrated=0.0103), "LOSS"),
        (row(error_percent=float("nan")), "LOSS"),
    ],
)
def test_verdicts(new: Row, verdict: str) -> None:
    assert remake_rows.judge(row(), new)[0] == verdict


@pytest.mark.parametrize("name", ["colour", "named"])
def test_another_verdict_about_a_robot_is_a_loss(name: str) -> None:
    old = {"bench": "verdict", "task": "arm", "seed": 1, "colour": "amber", "named": "yes", "chi2": 1.0}
    assert remake_rows.judge(old, {**old, "chi2": 1.1})[0] == "agrees"
    verdict, why = remake_rows.judge(old, {**old, name: "red"})
    assert verdict == "LOSS" and "-> red" in why


@pytest.mark.slow
def test_a_row_made_twice_has_the_same_bits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = stored(tmp_path, row(method="midpoint", seconds=0.1, profile="ideal"))
    first, again = tmp_path / "first", tmp_path / "again"
    assert remake_rows.main([str(path), "--folder", str(first)]) == 1, "the stored figures are invented"
    assert "LOSS" in capsys.readouterr().out
    assert remake_rows.main([str(path), "--folder", str(again), "--against", str(first)]) == 0
    assert "1 same" in capsys.readouterr().out


def test_a_bench_that_fails_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = stored(tmp_path, row(method="no-such-method"))
    assert remake_rows.main([str(path), "--folder", str(tmp_path / "new")]) == 1
    assert "failed stored: fixed-range cartpole no-such-method" in capsys.readouterr().out
