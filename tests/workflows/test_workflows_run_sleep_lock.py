"""The locks on sleep, against a stand-in of logind on a real D-Bus wire."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from fakes.logind import FakeLogind

from deal_hw.workflows.running.sleep_lock import awake

WAIT_S = 20.0


@pytest.fixture
def bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for a bus, which a run finds."""
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={tmp_path / 'bus'}")
    return tmp_path


def test_both_locks_are_held_for_the_run_and_released_after_it(bus: Path) -> None:
    """Sleep and lid are blocked, and nothing is reported."""
    printed: list[str] = []
    with FakeLogind(bus) as logind:
        with awake(lambda: None, printed.append):
            assert logind.asked == [
                ("sleep:handle-lid-switch", "deal-hw", "a robot would stay stiff", "block"),
                ("sleep", "deal-hw", "a robot would stay stiff", "delay"),
            ]
            assert not logind.released("block", 0.0) and not logind.released("delay", 0.0)
        assert logind.released("block") and logind.released("delay")
    assert printed == []


def test_a_sleep_that_comes_all_the_same_is_reported_before_it(bus: Path) -> None:
    """Over ssh only the delay is granted: the robot is made passive in it, and the operator knows."""
    printed: list[str] = []
    received = threading.Event()
    with FakeLogind(bus, refuse=("block",)) as logind:
        with awake(received.set, printed.append):
            (rule,) = logind.matches
            assert "member='PrepareForSleep'" in rule
            logind.prepare_for_sleep(begins=False)
            logind.prepare_for_sleep()
            assert received.wait(WAIT_S)
            assert not logind.released("delay", 0.0), "the run is not over yet"
        assert logind.released("delay")
    assert printed == [
        "note: nothing keeps this computer from sleeping (logind: Permission denied); a run then "
        "makes the robot passive first. Switch automatic sleep off, and leave the lid open"
    ]


def test_the_end_of_a_sleep_is_none(bus: Path) -> None:
    """The same signal says that the computer is awake again."""
    received: list[bool] = []
    with FakeLogind(bus) as logind, awake(lambda: received.append(True), lambda text: None):
        logind.prepare_for_sleep(begins=False)
    assert received == []


@pytest.mark.parametrize(
    ("refuse", "hangs", "exists", "why"),
    [
        (("block", "delay"), False, True, "Permission denied"),
        ((), True, True, "no answer within 0.1 s"),
        ((), False, False, "[Errno 2] No such file or directory"),
    ],
)
def test_without_a_lock_the_run_says_so_and_goes_on(
    bus: Path, refuse: tuple[str, ...], hangs: bool, exists: bool, why: str
) -> None:
    """In one line, whoever refuses; a bus that hangs holds nobody up."""
    answer_s = 0.1 if hangs else WAIT_S
    printed: list[str] = []
    if exists:
        with FakeLogind(bus, refuse, hangs=hangs), awake(lambda: None, printed.append, answer_s):
            pass
    else:
        with awake(lambda: None, printed.append, answer_s):
            pass
    assert printed == [
        f"note: nothing keeps this computer from sleeping (logind: {why}); the robot then holds "
        "its last command as long as it sleeps. Switch automatic sleep off, and leave the lid open"
    ]
