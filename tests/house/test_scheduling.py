"""How tests are spread over workers: a worker that ends takes one test with it, and no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1]
FILE = """
import os, pytest
@pytest.mark.parametrize("n", range(4))
def test_it(n):
    if {number} == 4 and n == 1:
        os._exit(1)
"""


@pytest.mark.slow
def test_all_tests_run_where_one_ends_its_worker(tmp_path: Path) -> None:
    """The test is named once and not begun again, and the run ends."""
    (tmp_path / "conftest.py").write_text((FOLDER / "conftest.py").read_text(encoding="utf-8"))
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = \n  real_time: x\n  slow: x\n")
    for number in range(6):
        (tmp_path / f"test_{number}.py").write_text(FILE.format(number=number))
    line = [sys.executable, "-m", "pytest", "-n", "2", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.stdout.splitlines()[-1].startswith("1 failed, 23 passed"), done.stdout
    assert "crashed while running 'test_4.py::test_it[1]'" in done.stdout
