"""Processor time of each test, set-up and child processes included, as a plugin of pytest.

PYTHONPATH=tools OMP_NUM_THREADS=1 .venv/bin/python -m pytest -p processor_time tests/calib

On a machine with other work, processor seconds mean more than seconds. The dearest files and tests come last.
A child counts when it has been waited for. A fixture counts for the test that asks for it first.
"""

from __future__ import annotations

import os
from collections.abc import Generator

import pytest

SHOWN = 25
"""Number of files and of tests that are printed."""
spent: dict[str, float] = {}
"""Processor seconds by test."""


def processor_s() -> float:
    """Return the processor time of this process and of its children so far [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measure a test with its set-up and its end."""
    begun = processor_s()
    try:
        return (yield)
    finally:
        spent[item.nodeid] = spent.get(item.nodeid, 0.0) + processor_s() - begun


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what was dearest."""
    files: dict[str, float] = {}
    for name, seconds in spent.items():
        file = name.partition("::")[0]
        files[file] = files.get(file, 0.0) + seconds
    terminalreporter.section(f"{sum(spent.values()):.0f} processor seconds in {len(spent)} tests")
    for kind in (files, spent):
        for name, seconds in sorted(kind.items(), key=lambda one: -one[1])[:SHOWN]:
            terminalreporter.write_line(f"{seconds:8.1f}  {name}")
        terminalreporter.write_line("")
