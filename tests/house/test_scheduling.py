"""How tests are spread over workers: none ends the others' tests, and each compiles a part of the files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).parents[1]
FILE = """
import os, pytest
@pytest.mark.parametrize("n", range(4))
def test_it(n):
    if {number} == 4 and n == 1:
        os._exit(1)
"""

LOADED = """
import os
with open(os.environ["LOADED_TO"], "a") as log:
    print(os.environ["PYTEST_XDIST_WORKER"], {number}, file=log)

def test_it():
    pass
"""


def run(folder: Path, workers: int, **environment: str) -> str:
    """Run tests under this repository's conftest.py and return what pytest printed."""
    (folder / "conftest.py").write_text((FOLDER / "conftest.py").read_text(encoding="utf-8"))
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = \n  real_time: x\n  slow: x\n")
    line = [sys.executable, "-m", "pytest", "-n", str(workers), "-q", "-p", "no:cacheprovider", str(folder)]
    return subprocess.run(
        line, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300
    ).stdout


def test_each_worker_collects_from_its_own_place_on(tmp_path: Path) -> None:
    """All load all files, each its own third first, and they agree on the order of the tests."""
    for number in range(6):
        (tmp_path / f"test_{number}.py").write_text(LOADED.format(number=number))
    log = tmp_path / "log"
    printed = run(tmp_path, 3, LOADED_TO=str(log))
    assert printed.splitlines()[-1].startswith("6 passed"), printed
    lines = [line.split() for line in log.read_text().splitlines()]
    loaded = {worker: [int(number) for one, number in lines if one == worker] for worker, _ in lines}
    assert loaded == {
        "gw0": [0, 1, 2, 3, 4, 5],
        "gw1": [2, 3, 4, 5, 0, 1],
        "gw2": [4, 5, 0, 1, 2, 3],
    }


def test_all_tests_run_where_one_ends_its_worker(tmp_path: Path) -> None:
    """The test is named once and not begun again, and the run ends."""
    for number in range(6):
        (tmp_path / f"test_{number}.py").write_text(FILE.format(number=number))
    printed = run(tmp_path, 2)
    assert printed.splitlines()[-1].startswith("1 failed, 23 passed"), printed
    assert "crashed while running 'test_4.py::test_it[1]'" in printed
