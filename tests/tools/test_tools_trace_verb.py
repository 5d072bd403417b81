"""What `tools/trace_verb.py` counts, on a small verb that was counted by hand."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import trace_verb

pytestmark = pytest.mark.skipif(sys.version_info < (3, 11), reason="functions have no qualified names")

TREE = {
    "deal_hw/__init__.py": "",
    "deal_hw/cli/__init__.py": "",
    "deal_hw/cli/main.py": (
        "from deal_hw.work import Work\n"
        "def run(name, words):\n    work = Work(int(words[0]))\n    work.do()\n    return 0\n"
    ),
    "deal_hw/table.py": "SQUARES = [n * n for n in range(3)]\ndef never():\n    pass\n",
    "deal_hw/work.py": (
        "import subprocess, sys\n"
        "from deal_hw.table import SQUARES\n"
        "class Work:\n"
        "    TWICE = tuple(2 * n for n in SQUARES)\n"
        "    def __init__(self, times):\n        self.times = times\n"
        "    def do(self):\n"
        "        each(self.times)\n"
        "        subprocess.run([sys.executable, '-c', 'pass'], check=True)\n"
        "        self.fit()\n"
        "    def fit(self):\n        after()\n"
        "def each(times):\n    return [one(number) for number in range(times)]\n"
        "def one(number):\n    def inside():\n        return number\n    return inside()\n"
        "def after():\n    pass\n"
    ),
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a checkout with the small verb and the tool."""
    for name, text in TREE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "tools").mkdir()
    shutil.copy(trace_verb.__file__, tmp_path / "tools")
    return tmp_path


def traced(checkout: Path, *words: str) -> tuple[int, list[str]]:
    """Return the exit code and the lines of the tool, in a process of its own: it hooks into Python."""
    command = [sys.executable, str(checkout / "tools/trace_verb.py"), *words]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert not done.stderr
    return done.returncode, done.stdout.splitlines()


def test_what_runs_until_a_function_is_counted(checkout: Path) -> None:
    """Functions by file, however often they are called; the named one has not run, and nothing after it."""
    code, lines = traced(checkout, "--until", "Work.fit", "--list", "work", "3")
    assert code == 0
    assert lines == [
        "deal_hw/cli/main.py: run",
        "deal_hw/work.py: Work.__init__, Work.do, each, one",
        "until Work.fit: 5 files loaded, 5 functions in 2 files called, 1 child processes",
        f"    {sys.executable} -c pass"[:104],
    ]


def test_a_function_that_is_never_called_is_an_error(checkout: Path) -> None:
    """The counts are of the whole verb then."""
    code, lines = traced(checkout, "--until", "never", "work", "0")
    assert code == 2
    assert lines[0] == "until the end: 5 files loaded, 6 functions in 2 files called, 1 child processes"
