"""Tasks in real workers of Ray on this machine: results, processes that are killed, what listens."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from deal_hw.errors import ConfigurationError, TaskLostError
from deal_hw.scale.where import task_map
from deal_hw.task_map import InThisProcess, TaskMap

# Not imported: tests are collected without it.
pytestmark = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed (extra scale)")


@pytest.fixture(scope="module")
def two() -> Iterator[TaskMap]:
    """Two workers, which all tests of this file share: their start takes some seconds of processor."""
    with task_map("local:2") as tasks:
        yield tasks


def power(shared: list[int], spec: int) -> tuple[int, int]:
    """A task with a value that all share."""
    return spec, spec ** len(shared)


def test_results_are_those_of_this_process(two: TaskMap) -> None:
    """In the order of the specifications."""
    task = partial(power, [0] * 3)
    assert two.map(task, range(20)) == InThisProcess().map(task, range(20))
    assert two.map(task, []) == []


def test_a_worker_knows_command_line_and_folder_and_has_one_thread(
    two: TaskMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relative paths mean the same there; numeric libraries do not take each other's processors."""

    def seen(_: int) -> tuple[list[str], str, str, str]:
        return sys.argv, os.getcwd(), os.environ["OMP_NUM_THREADS"], os.environ["OPENBLAS_NUM_THREADS"]

    monkeypatch.setattr(sys, "argv", ["deal-hw", "bench", "x"])
    monkeypatch.chdir(tmp_path)
    assert two.map(seen, [0]) == [(["deal-hw", "bench", "x"], str(tmp_path), "1", "1")]


def test_an_error_of_a_task_is_raised_here(two: TaskMap) -> None:
    """As its own class, so that it is handled as without workers."""

    def fails(spec: int) -> int:
        raise ConfigurationError(f"number {spec}")

    with pytest.raises(ConfigurationError, match="number 3"):
        two.map(fails, [3])


@pytest.mark.slow
def test_a_task_whose_worker_is_killed_is_done_again(two: TaskMap, tmp_path: Path) -> None:
    """By `kill -9`, as the kernel does where memory ends; the result is the same."""

    def dies_once(spec: int) -> int:
        mark = tmp_path / str(spec)
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 10 * spec

    assert two.map(dies_once, [1, 2]) == [10, 20]


def test_nothing_listens_beyond_this_machine(two: TaskMap) -> None:
    """Of all processes that were started."""
    here = psutil.Process()
    found = [
        place.laddr.ip for process in (here, *here.children(recursive=True)) for place in _listening(process)
    ]
    assert len(found) > 3 and {ip.removeprefix("::ffff:") for ip in found} == {"127.0.0.1"}


def _listening(process: psutil.Process) -> list[Any]:
    try:
        return [p for p in process.net_connections("inet") if p.status == psutil.CONN_LISTEN]
    except psutil.NoSuchProcess:
        return []


@pytest.mark.slow
def test_a_task_that_kills_each_worker_is_lost_and_the_others_are_done(two: TaskMap) -> None:
    """After four beginnings; it is one line with its remedy, or what the caller makes of it."""

    def dies(spec: int) -> int:
        if spec == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return spec

    lost = dict(two.completed(dies, [0, 1, 2], lambda spec, why: -spec))
    assert lost == {0: 0, 1: -1, 2: 2}
    with pytest.raises(TaskLostError, match=r"4 times.*enough memory") as caught:
        two.map(dies, [1])
    assert "\n" not in str(caught.value)
