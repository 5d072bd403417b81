"""Tests beside busy loops: the failures of each run are listed, and the loops end."""

from __future__ import annotations

import sys
from pathlib import Path

import psutil
import pytest
import test_under_load

pytestmark = pytest.mark.real_time


def test_failures_are_read_from_the_summary() -> None:
    """With and without a message; a parameter may have spaces; an error of the set-up counts."""
    printed = (
        "FAILED tests/a.py::test_one[a b] - assert 1 == 2 - 1\n"
        "FAILED tests/a.py::test_two\n"
        "ERROR tests/b.py - ImportError\n"
        "2 failed, 1 passed, 1 error in 0.1s\n"
    )
    assert test_under_load.failures(printed) == [
        "tests/a.py::test_one[a b]",
        "tests/a.py::test_two",
        "tests/b.py",
    ]


@pytest.mark.slow
def test_every_run_is_beside_the_loops_and_failures_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A test that always fails and one that passes, twice."""
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_it.py").write_text(
        "def test_bad():\n    assert 1 == 2\n\n\ndef test_good():\n    pass\n"
    )
    monkeypatch.chdir(tmp_path)
    line = ["test_under_load.py", "--loops", "2", "--repetitions", "2", "--workers", "0", "test_it.py"]
    monkeypatch.setattr(sys, "argv", line)
    assert test_under_load.main() == 1
    reported = capsys.readouterr().out
    assert reported.count("exit code 1: 1 failed, 1 passed") == 2
    assert reported.count("  FAILED test_it.py::test_bad - assert 1 == 2") == 2
    assert "failed in 2 of 2: test_it.py::test_bad" in reported
    left = [p.cmdline() for p in psutil.Process().children()]
    assert [sys.executable, "-c", test_under_load.BUSY] not in left


def test_runs_that_pass_end_with_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And nothing is listed. Loops beside it are the other test's."""
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "test_it.py").write_text("def test_good():\n    pass\n")
    monkeypatch.chdir(tmp_path)
    line = ["test_under_load.py", "--loops", "0", "--repetitions", "1", "--workers", "0", "test_it.py"]
    monkeypatch.setattr(sys, "argv", line)
    assert test_under_load.main() == 0
    assert "failed" not in capsys.readouterr().out
