"""The operator's keys, over a real terminal pair."""

from __future__ import annotations

import io
import os
import pty
import queue
import termios
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.workflows.running.keyboard import HELP, keys
from deal_hw.workflows.running.plan import RunPlan
from deal_hw.workflows.running.supervised import run_episodes

pytestmark = pytest.mark.real_time

PATIENCE_S = 20.0
STOP = "(stop)"


@dataclass
class Terminal:
    """A terminal: the operator's end, the program's end, and what the program made of the keys."""

    operator: int
    program: int
    received: queue.Queue[str] = field(default_factory=queue.Queue)

    def type(self, text: bytes) -> None:
        """Press keys."""
        os.write(self.operator, text)

    def stop(self) -> None:
        """Take the order to stop."""
        self.received.put(STOP)

    def next(self, count: int) -> list[str]:
        """Return the next things that were received."""
        return [self.received.get(timeout=PATIENCE_S) for _ in range(count)]


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """Standard input is the program's end of a terminal."""
    operator, program = pty.openpty()
    with os.fdopen(program, "r", closefd=False) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        made = Terminal(operator, program)
        yield made
    os.close(program)
    if made.operator >= 0:
        os.close(made.operator)


def test_keys_arrive_one_by_one_without_enter(terminal: Terminal, capsys: pytest.CaptureFixture[str]) -> None:
    """Letters and space, as they are typed; the help says which have a meaning."""
    with keys(terminal.received.put, terminal.stop):
        terminal.type(b"wa ")
        assert terminal.next(3) == ["w", "a", " "]
        terminal.type("é".encode())
        assert terminal.next(1) == ["é"]
    assert HELP in capsys.readouterr().err


def test_escape_stops_and_is_no_key(terminal: Terminal) -> None:
    """What follows still arrives: the run is over only when the control process says so."""
    with keys(terminal.received.put, terminal.stop):
        terminal.type(b"w\x1bs")
        assert terminal.next(3) == ["w", STOP, "s"]


def test_p_is_a_key_of_the_control_process(terminal: Terminal) -> None:
    """It ends the run as planned, so it goes the way of the other keys."""
    with keys(terminal.received.put, terminal.stop):
        terminal.type(b"wp")
        assert terminal.next(2) == ["w", "p"]


def test_a_key_that_is_held_stops_once(terminal: Terminal) -> None:
    """A second stop would kill a control process that is making the robot passive."""
    with keys(terminal.received.put, terminal.stop):
        terminal.type(b"\x1b\x1b\x1bw")
        assert terminal.next(2) == [STOP, "w"]
        terminal.type(b"\x1bd")
        assert terminal.next(1) == ["d"]


def test_the_terminal_is_as_before_afterwards(terminal: Terminal) -> None:
    """Echo and whole lines are off in between, and back after an error, too; Ctrl-C stays a signal."""
    before = termios.tcgetattr(terminal.program)
    assert before[3] & termios.ICANON and before[3] & termios.ECHO
    with pytest.raises(ZeroDivisionError), keys(terminal.received.put, terminal.stop):
        within = termios.tcgetattr(terminal.program)[3]
        assert not within & (termios.ICANON | termios.ECHO)
        assert within & termios.ISIG
        raise ZeroDivisionError
    assert termios.tcgetattr(terminal.program) == before


def test_no_descriptor_is_left(terminal: Terminal) -> None:
    """Episode after episode."""
    before = os.listdir("/proc/self/fd")
    for _ in range(3):
        with keys(terminal.received.put, terminal.stop):
            terminal.type(b"w")
            terminal.next(1)
    assert len(os.listdir("/proc/self/fd")) == len(before)


def test_a_terminal_that_goes_away_stops(terminal: Terminal) -> None:
    """Nobody is left to stop the robot by a key."""
    with keys(terminal.received.put, terminal.stop):
        terminal.type(b"w")
        assert terminal.next(1) == ["w"]
        os.close(terminal.operator)
        terminal.operator = -1
        assert terminal.next(1) == [STOP]
    assert terminal.received.empty()


def test_without_a_terminal_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As under a service manager; the message says what to use instead."""
    monkeypatch.setattr("sys.stdin", io.StringIO("w"))
    with pytest.raises(ConfigurationError, match=r"--velocity keyboard needs a terminal .*; use remote"):
        with keys(lambda key: None, lambda: None):
            pytest.fail("there is no terminal")


def test_a_run_without_a_terminal_does_not_begin(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It is reported before the port is opened, and before there is a recorder or a dataset."""
    monkeypatch.setattr("sys.stdin", io.StringIO("w"))
    plan = RunPlan(robot="cartpole", motion="hold", velocity="keyboard")
    with pytest.raises(ConfigurationError, match="needs a terminal"):
        run_episodes(
            plan, port=str(tmp_path / "no-port"), dataset=tmp_path / "data", episodes=1, purpose="collect"
        )
    assert not list(tmp_path.iterdir())
