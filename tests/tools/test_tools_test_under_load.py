"""Tests beside busy loops: the failures of each run are listed, and the loops end."""

from __future__ import annotations

import sys
from pathlib import Path

import psutil
import pytest
import test_under_load

pytestmark = pytest.mark.real_time


def test_failures_are_read_from_the_report() -> None:
    """A failure with its reason on one line, and an error of the set-up; what passed is none."""
    report = """<testsuites><testsuite>
      <testcase classname="tests.a" name="test_one[a b]">
        <failure message="assert 1&#10; == 2">...</failure>
      </testcase>
      <testcase classname="tests.a" name="test_two"/>
      <testcase classname="tests.b" name="test_three"><error message="ImportError">...</error></testcase>
    </testsuite></testsuites>"""
    assert test_under_load.failures(report) == {
        "tests.a::test_one[a b]": "assert 1 == 2",
        "tests.b::test_three": "ImportError",
    }


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
    assert reported.count("  test_it::test_bad: assert 1 == 2") == 2
    assert "failed in 2 of 2: test_it::test_bad" in reported
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
