"""No test sleeps: it waits for an event, or its clock is virtual. A sleep is too short on a busy machine."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
SLEEPS = ("time.sleep", "asyncio.sleep", "MonotonicClock().sleep_until_ns")
IN_REAL_TIME = {
    "control/test_control_processes_simulator.py": "the stand-in of a simulator runs in real time",
    "data/test_data_recorder_process.py": "the recorder, another process, closes its chunks by its own clock",
}
"""Files that may wait by the machine's clock, and why. To wait for another process: `fakes.waiting.until`."""


def sleeps(source: str) -> list[str]:
    """Return what a test's source calls to sleep, in its own process."""
    if "sleep" not in source:
        return []
    tree = ast.parse(source)
    modules = {"time": "time", "asyncio": "asyncio"}
    functions: dict[str, str] = {}
    real: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {name.asname or name.name: name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            functions |= {name.asname or name.name: f"{node.module}.{name.name}" for name in node.names}
        elif isinstance(node, ast.Assign) and "MonotonicClock()" in ast.unparse(node.value):
            real |= {name for target in node.targets for name in ast.unparse(target).strip("()").split(", ")}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            begin, _, end = called.rpartition(".")
            if begin in real:
                begin = "MonotonicClock()"
            name = functions.get(called, f"{modules.get(begin, begin)}.{end}")
            found += [name] * (name in SLEEPS)
    return found


def test_no_test_sleeps() -> None:
    """It waits by `fakes.waiting.until` for another process; a thread of its own sets an event."""
    names = {path.relative_to(TESTS).as_posix(): path for path in TESTS.rglob("*.py")}
    assert len(names) > 100
    found = {name: sleeps(path.read_text(encoding="utf-8")) for name, path in names.items()}
    assert {name for name, calls in found.items() if calls} == set(IN_REAL_TIME)
    assert {call for calls in found.values() for call in calls} == {"MonotonicClock().sleep_until_ns"}


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("import time\ntime.sleep(1)", "time.sleep"),
        ("import time as t\ndef wait():\n    t.sleep(1)", "time.sleep"),
        ("from time import sleep as nap\nnap(1)", "time.sleep"),
        ("import asyncio\nasyncio.sleep(1)", "asyncio.sleep"),
        ("clock, stop = MonotonicClock(), 1\nclock.sleep_until_ns(1)", "MonotonicClock().sleep_until_ns"),
    ],
    ids=["module", "alias", "function", "asyncio", "clock"],
)
def test_a_sleep_is_found(source: str, name: str) -> None:
    """However it is imported; a child's program in a string and a virtual clock are no sleep."""
    assert sleeps(source) == [name]
    assert sleeps(repr(source)) == []
    assert sleeps(source.replace("Monotonic", "Virtual").replace("sleep", "monotonic")) == []
