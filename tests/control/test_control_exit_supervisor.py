"""The supervisor over control processes that die, stall, lie and linger: real processes, a few bytes each."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from deal_hw import load
from deal_hw.clock import VirtualClock
from deal_hw.control.process import supervisor as module
from deal_hw.control.process.channel import Beat
from deal_hw.control.process.run_note import RunNote
from deal_hw.control.process.supervisor import ChildEnd, Supervisor
from deal_hw.data.recording.recorder_launch import RecorderOutcome
from deal_hw.priorities import SUPERVISOR_PRIORITY
from deal_hw.signals import OPERATOR, SUSPENDED

pytestmark = pytest.mark.real_time

LONG_S = 300.0
"""Time for the control process to end after its last message. It has an ordinary priority, and closing its
channel wakes up a supervisor that has a higher one, in the middle of its end: on a busy machine it may get
the processor back after more than the 3 s of a real run."""
CHILD = """
import json, os, signal, socket, struct, sys, time

signal.alarm(20)  # Whoever forgets this process waits no longer.
signal.pthread_sigmask(signal.SIG_SETMASK, [])
orders = json.load(sys.stdin)
channel = socket.socket(fileno=orders["status_fd"])
channel.setblocking(True)


def beat(phase, silence_s=20.0):
    channel.send(struct.pack("<cqdI", b"H", time.monotonic_ns(), silence_s, 0) + phase.encode())


def result(**values):
    channel.send(b"R" + json.dumps(values).encode())


def on_term(act):
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGTSTP):
        signal.signal(number, lambda *_: act())


def stopped():
    result(passive_confirmed=True, how="requested")
    os._exit(0)


exec(orders["do"])
"""


class Run:
    """A supervisor over a control process that follows a script.

    Attributes:
        passive: What the supervisor was asked for once the process was dead: phase, tried already.
    """

    def __init__(
        self, do: str, at: Callable[[Run, Beat], None] = lambda run, beat: None, **settings: Any
    ) -> None:
        self.passive: list[tuple[str, bool]] = []
        self.beats: list[str] = []
        self._at = at
        self.supervisor = Supervisor(
            module="deal_hw_obedient_child",
            plan={"do": do},
            port_fd=None,
            passive=self._passive,
            on_beat=self._on_beat,
            **{"grace_s": LONG_S, **settings},
        )

    def _passive(self, phase: str, already_tried: bool) -> bool:
        child = self.supervisor._child
        assert child is None or child.returncode is not None, "the control process is dead first"
        self.passive.append((phase, already_tried))
        return True

    def _on_beat(self, beat: Beat) -> None:
        self.beats.append(beat.phase)
        self._at(self, beat)

    def end(self) -> ChildEnd:
        """Run to the end."""
        return self.supervisor.run()


@pytest.fixture(autouse=True)
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The control process's module."""
    (tmp_path / "deal_hw_obedient_child.py").write_text(CHILD)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def test_a_process_that_ends_well_leaves_nothing_to_do() -> None:
    """Its word that the robot is passive is believed, and nothing is sent."""
    run = Run("beat('running'); result(passive_confirmed=True)")
    end = run.end()
    assert end == ChildEnd({"passive_confirmed": True}, 0, "", "", True, None, "")
    assert run.passive == []
    assert run.beats == ["running"]


@pytest.mark.parametrize(
    ("do", "phase", "already_tried", "code"),
    [
        ("sys.exit(7)", "starting", False, 7),
        ("beat('connecting'); os.kill(os.getpid(), 9)", "connecting", False, -9),
        ("beat('running'); os.kill(os.getpid(), 9)", "running", False, -9),
        ("beat('making passive: x'); result(passive_confirmed=False)", "making passive: x", True, 0),
        ("beat('arming'); result(outcome='failed')", "arming", True, 0),
    ],
)
def test_who_makes_passive_is_told_when_it_died_and_whether_it_tried(
    do: str, phase: str, already_tried: bool, code: int
) -> None:
    """The last received phase; a report without the word means that the process tried without success."""
    run = Run(do)
    end = run.end()
    assert run.passive == [(phase, already_tried)]
    assert (end.passive_confirmed, end.exit_code, end.killed) == (True, code, "")


def test_a_process_that_does_not_read_its_orders_is_survived() -> None:
    """It is gone before it could: the orders lie in a file, and nothing waits."""
    run = Run("pass")
    run.supervisor._module = "antigravity_that_is_not_there"
    run.supervisor._plan = {"do": "x" * 1_000_000}
    assert run.end().exit_code == 1
    assert run.passive == [("starting", False)]


def test_a_process_that_falls_silent_is_killed() -> None:
    """20 ms were allowed; the phase is named."""
    run = Run("beat('homing', 0.02); time.sleep(600)")
    end = run.end()
    assert (end.killed, end.exit_code) == ("it sent no heartbeat while homing", -9)
    assert run.passive == [("homing", False)]


def test_a_process_that_lingers_after_its_last_word_is_killed() -> None:
    """Its report counts, though it never read our heartbeats: the kernel then reports a reset first."""
    run = Run("result(passive_confirmed=True); channel.close(); time.sleep(600)", grace_s=0.05)
    end = run.end()
    assert (end.killed, end.exit_code) == ("it did not end after its last message", -9)
    assert end.result == {"passive_confirmed": True}
    assert run.passive == []


def test_a_failing_supervisor_leaves_no_process_and_a_passive_robot() -> None:
    """What failed comes out afterwards."""

    def fail(run: Run, beat: Beat) -> None:
        raise ZeroDivisionError("in the display")

    run = Run("beat('running'); time.sleep(600)", fail)
    with pytest.raises(ZeroDivisionError, match="in the display"):
        run.end()
    assert run.passive == [("running", False)]
    assert run.supervisor._killed == "the supervisor failed"


@pytest.mark.parametrize(
    ("number", "cause"),
    [
        (signal.SIGINT, "stopped by the operator"),
        (signal.SIGTERM, "stopped by the operator"),
        (signal.SIGHUP, "the terminal or the session was closed (SIGHUP)"),
        (signal.SIGTSTP, "suspended by the operator (Ctrl-Z)"),
    ],
)
def test_the_operators_signals_ask_once_and_are_named(number: signal.Signals, cause: str) -> None:
    """The process ends by its passive route; Ctrl-Z stops nothing yet; the handlers of before are back."""

    def ours(number: int, frame: FrameType | None) -> None:
        raise AssertionError("the signal did not reach the supervisor")

    before = signal.signal(number, ours)
    run = Run(
        "on_term(stopped); beat('running'); time.sleep(600)", lambda run, beat: os.kill(os.getpid(), number)
    )
    end = run.end()
    assert signal.signal(number, before) is ours
    assert end == ChildEnd(
        {"passive_confirmed": True, "how": "requested"}, 0, "", cause, True, None, number.name
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTSTP])
def test_the_operators_late_second_wish_kills(number: signal.Signals) -> None:
    """The process does not end by its passive route: the robot is the supervisor's then."""

    def twice(run: Run, beat: Beat) -> None:
        os.kill(os.getpid(), number)

    do = "on_term(lambda: beat('running')); beat('running'); time.sleep(600); time.sleep(600)"
    run = Run(do, twice, patience_s=0.0)
    end = run.end()
    assert (end.killed, end.exit_code) == ("it did not end when it was asked, and was asked again", -9)
    assert run.passive == [("running", False)]


def test_requests_at_once_are_one_request() -> None:
    """An ending session sends SIGTERM and SIGHUP; a held key repeats. The second must not kill."""

    def storm(run: Run, beat: Beat) -> None:
        for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT, signal.SIGINT):
            os.kill(os.getpid(), number)

    end = Run("on_term(stopped); beat('running'); time.sleep(600)", storm).end()
    assert (end.killed, end.exit_code, end.signal) == ("", 0, "SIGTERM")


def test_the_first_signal_is_the_one_that_is_named() -> None:
    """Ctrl-Z, then Ctrl-C."""

    def both(run: Run, beat: Beat) -> None:
        os.kill(os.getpid(), signal.SIGTSTP if len(run.beats) == 1 else signal.SIGINT)

    do = "on_term(lambda: beat('running')); beat('running'); time.sleep(600); time.sleep(600)"
    run = Run(do, both, patience_s=0.0)
    end = run.end()
    assert (end.signal, end.stop_cause, end.killed != "") == ("SIGTSTP", SUSPENDED, True)


def test_a_stop_before_the_start_is_obeyed() -> None:
    """The process is asked as soon as it is there; the first reason counts."""
    run = Run("pass")
    run.supervisor.stop("the recorder failed")
    run.supervisor.stop(OPERATOR)
    end = run.end()
    assert (end.exit_code, end.stop_cause, end.killed) == (-15, "the recorder failed", "")
    assert run.passive == [("starting", False)]


def test_words_reach_a_process_that_is_there_and_nobody_else() -> None:
    """Too early and too late they are lost without a sound."""

    def speak(run: Run, beat: Beat) -> None:
        run.supervisor.tell("w")

    do = "beat('running'); got = [];\nwhile 'w' not in got: got.append(channel.recv(64).decode())\n"
    run = Run(do + "result(passive_confirmed=True)", speak)
    run.supervisor.tell("too early")
    assert run.end().passive_confirmed
    run.supervisor.tell("too late")


def test_in_another_thread_signals_are_left_alone() -> None:
    """Python allows handlers in the main thread only."""
    ends: list[ChildEnd] = []
    run = Run("result(passive_confirmed=True)")
    thread = threading.Thread(target=lambda: ends.append(run.end()))
    thread.start()
    thread.join()
    assert ends[0].passive_confirmed
    run.supervisor.stop("too late")


def test_the_supervisor_beats_and_keeps_descriptors_open(tmp_path: Path) -> None:
    """Three heartbeats reach the process; what it inherits is what was named, and the channel."""
    do = (
        "received = [channel.recv(64) for _ in range(3)]; "
        "result(passive_confirmed=True, received=[h.decode() for h in received], "
        "opened=os.path.exists(f'/proc/self/fd/{orders[\"keep\"]}'), parent=orders['parent_pid'])"
    )
    with (tmp_path / "claim").open("w") as claim:
        run = Run(do, keep_fds=[claim.fileno()])
        run.supervisor._plan = {**run.supervisor._plan, "keep": claim.fileno()}
        end = run.end()
    assert end.result == {
        "passive_confirmed": True,
        "received": ["\0"] * 3,
        "opened": True,
        "parent": os.getpid(),
    }


def _noted(note: RunNote) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(os.pread(note.fileno(), 4096, 0))
    return found


def test_other_programs_read_how_the_run_is() -> None:
    """Whether the robot is passive, as soon as that is known, and until when the supervisor is silent."""
    noted: list[tuple[bool | None, bool]] = []
    with RunNote("go2", {}) as note:

        def look(run: Run, beat: Beat) -> None:
            facts = _noted(note)
            noted.append((facts["passive"], facts["silent_until_ns"] > beat.stamp_ns))

        run = Run(
            "beat('running'); time.sleep(0.2); result(passive_confirmed=True, opened=os.path.realpath("
            f"'/proc/self/fd/{note.fileno()}'))",
            look,
            note=note,
        )
        end = run.end()
        assert end.result is not None and "deal-hw-run:go2" in end.result["opened"]
        assert noted == [(None, True)]
        assert _noted(note)["passive"] is True
        assert not run.supervisor.was_away


@pytest.mark.parametrize("confirmed", [True, False])
def test_the_note_says_what_the_supervisor_reached(confirmed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the control process is dead: its own attempt counts."""
    with RunNote("go2", {}) as note:
        run = Run("beat('running'); os.kill(os.getpid(), 9)", note=note)
        monkeypatch.setattr(run.supervisor, "_passive", lambda phase, tried: confirmed)
        assert run.end().passive_confirmed is confirmed
        assert _noted(note)["passive"] is confirmed


def test_a_supervisor_notices_that_it_did_not_run() -> None:
    """For more than 0.8 s between two looks, to the nanosecond: then others may have taken the robot."""

    class Jumping(VirtualClock):
        jump_ns = 0

        def now_ns(self) -> int:
            """Jump once, as for a process that was stopped."""
            self.advance_ns(self.jump_ns)
            self.jump_ns = 0
            return super().now_ns()

    for jump_ns, away in ((800_000_000, False), (800_000_001, True)):
        clock = Jumping()

        def stop(run: Run, beat: Beat, clock: Jumping = clock, jump_ns: int = jump_ns) -> None:
            clock.jump_ns = jump_ns if beat.phase == "running" else 0

        do = "beat('homing'); channel.recv(1); beat('running'); channel.recv(1); "
        do += "result(passive_confirmed=True)"
        run = Run(do, stop, clock=clock)
        assert run.end().passive_confirmed
        assert run.supervisor.was_away is away


def test_the_process_has_a_group_of_its_own_and_ordinary_priority() -> None:
    """Ctrl-C in the terminal reaches the supervisor alone; the supervisor's priority is not inherited."""
    run = Run(
        "result(passive_confirmed=True, group=os.getpgrp() == os.getpid(), policy=os.sched_getscheduler(0))"
    )
    end = run.end()
    assert end.result == {"passive_confirmed": True, "group": True, "policy": os.SCHED_OTHER}


def test_the_supervisor_runs_first_and_stays_in_memory() -> None:
    """While it watches, where that is granted; not before and not after."""
    seen: list[tuple[int, bool]] = []

    def locked() -> bool:
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmLck:")[2].split()[0]) > 0

    def look(run: Run, beat: Beat) -> None:
        seen.append((os.sched_getparam(0).sched_priority, locked()))

    assert Run("beat('running'); result(passive_confirmed=True)", look).end().passive_confirmed
    if os.geteuid() != 0:
        pytest.skip("neither is granted to this user")
    assert seen == [(SUPERVISOR_PRIORITY, True)]
    assert (os.sched_getparam(0).sched_priority, locked()) == (0, False)


def test_heartbeats_go_by_the_clock() -> None:
    """A clock that stands still makes one, at once, however often the supervisor wakes up."""
    do = (
        "[(beat('running'), time.sleep(0.02)) for _ in range(10)]; channel.setblocking(False); "
        "result(passive_confirmed=True, received=channel.recv(64).decode()); "
        "time.sleep(0.1); n = 0\n"
        "try:\n    channel.recv(64); n = 1\nexcept BlockingIOError:\n    pass\n"
        "sys.exit(n)"
    )
    end = Run(do, clock=VirtualClock(0)).end()
    assert end.result == {"passive_confirmed": True, "received": "\0"}
    assert end.exit_code == 0


def test_the_supervisor_wakes_up_as_soon_as_a_sign_of_life_is_overdue(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every 50 ms otherwise. 1 ms more, because the kernel may wake it up a little early."""
    waits: list[float] = []
    true_select = select.select
    do = (
        "channel.send(struct.pack('<cqdI', b'H', 10**9, 0.02, 0) + b'running')\n"
        "while channel.recv(64) != b'go on': pass\n"
        "channel.send(struct.pack('<cqdI', b'H', 10**9 - 1, 0.0, 0) + b'homing'); time.sleep(600)"
    )
    run = Run(do, clock=VirtualClock(10**9))

    def wait(read: list[Any], write: list[Any], other: list[Any], timeout_s: float) -> Any:
        waits.append(timeout_s)
        if len(run.beats) == 1:
            run.supervisor.tell("go on")
        return true_select(read, write, other, timeout_s)

    monkeypatch.setattr("select.select", wait)
    assert run.end().killed == "it sent no heartbeat while homing"
    assert waits[0] == 0.05
    assert waits[-2:] == pytest.approx([0.021, 0.001], rel=1e-9)


def test_a_process_that_never_beats_has_thirty_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the nanosecond: it is let live at 30 s, and killed 1 ns later. The message says why."""
    monkeypatch.setattr(load, "waited_s", lambda pid: 0.0)

    class Late(VirtualClock):
        asked = 0

        def now_ns(self) -> int:
            """Stand still while it starts, then at 30 s for a while, then 1 ns later."""
            self.asked += 1
            return 0 if self.asked == 1 else 30 * 10**9 + (self.asked > 30)

    clock = Late()
    end = Run("time.sleep(30); sys.exit(7)", clock=clock).end()
    assert end.killed.startswith(
        "it sent no heartbeat while starting in its time, 30 s of its own and 0 s in which"
    )
    assert end.exit_code == -9
    assert clock.asked > 30


@pytest.mark.parametrize("phase", ["starting", "loading"])
def test_a_busy_computer_gives_a_process_more_time_to_start(
    phase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waited for a processor for 40 s. Once it commands, this does not count."""
    monkeypatch.setattr(load, "waited_s", lambda pid: 40.0 if begun else 0.0)
    begun: list[bool] = []

    class Late(VirtualClock):
        jumped = False

        def now_ns(self) -> int:
            """Jump by 60 s, once the process is there."""
            if begun and not self.jumped:
                self.jumped = True
                self.advance_ns(60 * 10**9)
            return super().now_ns()

    monkeypatch.setattr(Supervisor, "_notice_absence", lambda supervisor: begun.append(True))
    do = "channel.recv(1)" if phase == "starting" else "beat('loading', 0.0); channel.recv(1)"
    end = Run(f"{do}; time.sleep(0.2); result(passive_confirmed=True)", clock=Late()).end()
    assert (end.killed, end.passive_confirmed) == ("", True)


def test_a_process_that_commands_gets_no_more_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it waited for a processor: a robot may be stiff meanwhile."""
    monkeypatch.setattr(load, "waited_s", lambda pid: 40.0)
    assert Run("beat('homing', 0.02); time.sleep(600)").end().killed == "it sent no heartbeat while homing"


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> list[float | None]:
    """For how long the end of a process may be waited for [s]; None without a limit. None strikes."""
    found: list[float | None] = []
    true_wait = subprocess.Popen.wait

    def wait(child: subprocess.Popen[bytes], timeout: float | None = None) -> int:
        found.append(timeout)
        return true_wait(child)

    monkeypatch.setattr(subprocess.Popen, "wait", wait)
    return found


def test_a_process_has_three_seconds_to_end_after_its_last_word(limits: list[float | None]) -> None:
    """It still has its files to close."""
    assert Run("result(passive_confirmed=True)", grace_s=module.GRACE_S).end().exit_code == 0
    assert limits == [3.0]


def test_what_is_killed_is_hurried_and_waited_for_without_a_limit(
    monkeypatch: pytest.MonkeyPatch, limits: list[float | None]
) -> None:
    """The robot is stiff meanwhile: no time is lost on a busy machine, nor by a wait that polls."""
    hurried: list[int] = []
    monkeypatch.setattr(module, "raise_priority", hurried.append)
    run = Run("beat('homing', 0.02); time.sleep(600)")
    assert run.end().exit_code == -9
    assert run.supervisor._child is not None and hurried == [run.supervisor._child.pid]
    assert limits == [None]


class Recorder:
    """A recorder's handle, whose disk may fill."""

    def __init__(self, errors: tuple[str, ...]) -> None:
        self.control_socket, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._errors = errors
        self.released = 0

    def errors(self) -> tuple[str, ...]:
        """Return what went wrong, once a cycle has come."""
        return self._errors if select.select([self.far], [], [], 0)[0] else ()

    def release(self) -> None:
        """Close our copy."""
        self.released += 1
        self.control_socket.close()

    def finish(self) -> RecorderOutcome:
        """End it."""
        assert self.far.recv(64) == b"a cycle"
        self.far.close()
        return RecorderOutcome(True, 1, 4, self._errors)


@pytest.mark.parametrize(
    ("errors", "cause"), [((), ""), (("no space left",), "the recorder failed: no space left")]
)
def test_a_recorder_that_fails_ends_the_run(errors: tuple[str, ...], cause: str) -> None:
    """The process inherits its end of the socket; its outcome comes with the end."""
    recorder = Recorder(errors)
    do = (
        "on_term(stopped); socket.socket(fileno=orders['record_fd']).send(b'a cycle'); beat('running'); "
        "time.sleep(600) if orders['wait'] else result(passive_confirmed=True)"
    )
    run = Run(do, recorder=recorder)
    run.supervisor._plan = {**run.supervisor._plan, "wait": bool(errors)}
    end = run.end()
    assert (end.stop_cause, end.recorder) == (cause, RecorderOutcome(True, 1, 4, errors))
    assert recorder.released == 1
