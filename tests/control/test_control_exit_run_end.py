"""The end of a run from another program: its processes are real, and stopped, hung, killed or slow."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from fakes.waiting import PATIENCE_S, until

from deal_hw.clock import MonotonicClock
from deal_hw.control.process import run_end as module
from deal_hw.control.process.realtime import process_state
from deal_hw.control.process.run_end import RunEnd
from deal_hw.control.process.run_note import FoundRun, RunNote, find_runs

pytestmark = pytest.mark.real_time

FAR_NS = 1 << 62
RUN = """
import os, select, signal, sys, time
from deal_hw.control.process.run_note import RunNote

def ignore(*numbers):
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)

def ended(pid):
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

def control(do):
    pid = os.fork()
    if pid == 0:
        do()
        os._exit(0)
    return pid

def sleep():
    while True:
        select.select([], [], [], 1)

signal.alarm(100)  # Whoever forgets this process waits no longer.
with RunNote("go2", {"claim": "x"}) as note:
    note.say_passive(None)
    note.beat(1 << 62)
    exec(sys.argv[1])
"""
WATCHES = """
ignore(signal.SIGTERM)
pid = control(sleep)
print(pid, flush=True)
while not ended(pid):
    time.sleep(0.005)
note.say_passive(True)
sys.stdin.read()
"""
"""A supervisor that makes the robot passive once its control process is dead, and ignores all requests."""


class Run:
    """A run whose processes follow a script; it prints the number of its control process, or 0."""

    def __init__(self, do: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", RUN, do], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.control = int(self.process.stdout.readline())

    @property
    def pid(self) -> int:
        """The supervisor."""
        return self.process.pid

    def found(self) -> FoundRun:
        """Return the run as another program finds it."""
        (found,) = [run for run in find_runs() if run.pid == self.pid]
        return found


@pytest.fixture
def start() -> Iterator[Callable[[str], tuple[Run, RunEnd]]]:
    """Start runs; what is left of them ends with the test."""
    runs: list[Run] = []
    with ExitStack() as notes:

        def begin(do: str) -> tuple[Run, RunEnd]:
            runs.append(Run(do))
            found = notes.enter_context(runs[-1].found())
            return runs[-1], RunEnd(found, MonotonicClock())

        yield begin
    for run in runs:
        for pid in (run.control, run.pid):
            if pid and process_state(pid) not in "ZX":
                os.kill(pid, signal.SIGKILL)
        run.process.communicate(timeout=PATIENCE_S)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """What these tests see is decided by the states of processes: a wait would end with the test's time."""
    monkeypatch.setattr(module, "OBEY_S", 10 * PATIENCE_S)
    monkeypatch.setattr(module, "ACT_S", 10 * PATIENCE_S)


def stopped(*pids: int) -> None:
    """Stop processes, and wait until they are."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    until(lambda: all(process_state(pid) == "T" for pid in pids), "the processes are stopped")


def test_both_processes_get_the_request(start: Callable[[str], tuple[Run, RunEnd]]) -> None:
    """Whichever acts first makes the robot passive; the run is not killed."""
    run, end = start(
        "pid = control(sleep); note.beat(1 << 62)\n"
        "signal.signal(signal.SIGTERM, lambda *_: (note.say_passive(True), sys.exit(130)))\n"
        "print(pid, flush=True); sleep()"
    )
    end.request()
    assert end.wait()
    assert run.process.wait(PATIENCE_S) == 130
    until(lambda: process_state(run.control) in "ZX", "the control process got it, too")


def test_a_stopped_control_process_is_killed_and_its_supervisor_acts(
    start: Callable[[str], tuple[Run, RunEnd]],
) -> None:
    """At once, however long it may be silent; the supervisor, which works, is left alone."""
    run, end = start(WATCHES)
    stopped(run.control)
    end.request()
    assert end.wait()
    assert process_state(run.control) in "ZX"
    assert run.process.poll() is None


def test_a_stopped_supervisor_is_continued(start: Callable[[str], tuple[Run, RunEnd]]) -> None:
    """It has the connection; its control process, which is stopped, too, is killed before."""
    run, end = start(WATCHES)
    stopped(run.control, run.pid)
    end.request()
    assert end.wait()
    assert run.process.poll() is None, "it is not killed"


def test_a_supervisor_that_stays_stopped_is_killed(start: Callable[[str], tuple[Run, RunEnd]]) -> None:
    """As one under a debugger: then nobody of the run is left, and the robot is not passive."""
    run, end = start(
        "ignore(signal.SIGTERM); again = lambda *_: os.kill(os.getpid(), signal.SIGSTOP)\n"
        "signal.signal(signal.SIGCONT, again); pid = control(sleep); print(pid, flush=True); sleep()"
    )
    stopped(run.control, run.pid)
    end.request()
    assert not end.wait()
    assert run.process.wait(PATIENCE_S) == -signal.SIGKILL
    assert process_state(run.control) in "ZX"


def test_a_hung_supervisor_is_killed_once_its_control_process_is_dead(
    start: Callable[[str], tuple[Run, RunEnd]],
) -> None:
    """It is not stopped, but its note promised a word long ago. The control process obeys and ends."""
    run, end = start(
        "ignore(signal.SIGTERM); note.beat(1)\n"
        "pid = control(lambda: (signal.signal(signal.SIGTERM, signal.SIG_DFL), sleep()))\n"
        "print(pid, flush=True); sleep()"
    )
    end.request()
    assert not end.wait()
    assert run.process.wait(PATIENCE_S) == -signal.SIGKILL


def test_a_hung_run_is_killed_its_control_process_first(
    start: Callable[[str], tuple[Run, RunEnd]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither is stopped, and neither obeys: the control process has half a second."""
    monkeypatch.setattr(module, "ACT_S", 0.0)
    killed: list[int] = []
    true_kill = os.kill

    def kill(pid: int, number: int) -> None:
        if number == signal.SIGKILL:
            killed.append(pid)
        true_kill(pid, number)

    run, end = start(
        "ignore(signal.SIGTERM); note.beat(1); pid = control(sleep); print(pid, flush=True); sleep()"
    )
    monkeypatch.setattr(os, "kill", kill)
    end.request()
    assert not end.wait()
    assert killed == [run.control, run.pid]


def test_a_run_that_works_but_does_not_obey_is_killed_late(
    start: Callable[[str], tuple[Run, RunEnd]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its control process first, which lets its supervisor act."""
    monkeypatch.setattr(module, "OBEY_S", 0.2)
    run, end = start("ignore(signal.SIGTERM)\n" + WATCHES)
    end.request()
    assert end.wait()
    assert process_state(run.control) in "ZX"
    assert run.process.poll() is None


def test_a_supervisor_that_does_not_act_is_killed_last(
    start: Callable[[str], tuple[Run, RunEnd]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It works, by its note, but its robot does not become passive."""
    monkeypatch.setattr(module, "OBEY_S", 0.1)
    monkeypatch.setattr(module, "TAKE_OVER_S", 0.1)
    run, end = start("ignore(signal.SIGTERM); print(0, flush=True); sleep()")
    end.request()
    while end._run.holders():
        assert not end.wait()
    assert run.process.wait(PATIENCE_S) == -signal.SIGKILL


def test_a_run_that_may_not_be_killed_is_given_up(
    start: Callable[[str], tuple[Run, RunEnd]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one of another user."""

    def refused(pid: int, number: int) -> None:
        raise PermissionError

    run, end = start("print(0, flush=True); sleep()")
    monkeypatch.setattr(module, "OBEY_S", 0.05)
    monkeypatch.setattr(module, "TAKE_OVER_S", 0.05)
    with monkeypatch.context() as another_user:
        another_user.setattr(os, "kill", refused)
        end.request()
        assert not end.wait()
    assert run.process.poll() is None


def test_a_run_that_is_dead_needs_no_wait(start: Callable[[str], tuple[Run, RunEnd]]) -> None:
    """What it said last counts."""
    for said in (True, False):
        run, end = start(f"note.say_passive({said}); print(0, flush=True); sys.stdin.read()")
        run.process.communicate(timeout=PATIENCE_S)
        end.request()
        assert end.wait() is said


def test_a_number_that_is_another_programs_by_now_is_not_killed(
    start: Callable[[str], tuple[Run, RunEnd]],
) -> None:
    """Only who has the run's note is killed."""
    run, end = start(WATCHES)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        stopped(other.pid, run.control)
        end.request()
        end._pids.append(other.pid)
        assert end.wait()
        assert process_state(other.pid) == "T"
        os.kill(other.pid, signal.SIGCONT)
        other.communicate(b"\n")


def test_silence_counts_from_what_was_promised() -> None:
    """To the nanosecond; without a promise nobody hangs."""
    with RunNote("go2", {}) as note:
        found = FoundRun(note.fileno(), 1, _facts(note))
        assert not found.hangs(FAR_NS)
        note.beat(5_000)
        assert not found.hangs(5_000)
        assert found.hangs(5_001)
        note.say_passive(None)
        assert found.hangs(5_001), "what else it says takes nothing back"


def _facts(note: RunNote) -> Any:
    return {"pid": 1, "passive": None, "robot": "go2"}
