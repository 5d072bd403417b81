"""Signals: which are taken, what a process does on them, in every phase and order, in virtual time."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import threading
import types
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from fakes.go2 import STIFF, FakeBench

from deal_hw import signals
from deal_hw.clock import VirtualClock
from deal_hw.control.loop.control_loop import ControlLoop, LoopConfig, LoopReport
from deal_hw.control.process.channel import Outcome
from deal_hw.control.process.realtime import PARENT_DIED, kill_self_after, parent_is_gone
from deal_hw.control.process.supervisor import PATIENCE_S, Supervisor
from deal_hw.control.safety.passive import PassiveConfig, make_passive
from deal_hw.control.safety.safety import Safety
from deal_hw.drivers.go2.descriptions.on_stand import DESCRIPTION as ON_STAND
from deal_hw.drivers.go2.messages.low_command import decode_low_command
from deal_hw.drivers.go2.robot import Go2OnStandRobot
from deal_hw.motions.behaviours import HoldBehaviour
from deal_hw.workflows.running import control_process
from deal_hw.workflows.running.control_process import _Stopper

# The time limit of a test is a handler of SIGALRM, which these tests set themselves.
pytestmark = [pytest.mark.real_time, pytest.mark.timeout(0)]

DEFAULT = {
    "end": "HUP INT QUIT TERM ALRM XCPU USR1 USR2 VTALRM PROF IO PWR STKFLT ABRT TRAP SYS TSTP",
    "left": "KILL STOP SEGV BUS FPE ILL CHLD CONT URG WINCH TTIN TTOU PIPE XFSZ",
}
"""Signals by what becomes of them, written from signal(7)."""
NAMED = tuple(signal.Signals[f"SIG{name}"] for name in DEFAULT["end"].split())
SENT = tuple(
    number
    for number in (*NAMED, signal.SIGRTMIN, signal.SIGRTMAX)
    # pytest's faulthandler has it; tests in a process of their own send it.
    if number != signal.SIGABRT
)
"""Each is sent first, and after each other one."""
PHASES = ("connecting", "homing", "arming", "running", "making passive")


# Which signals.


def test_every_signal_is_either_taken_or_named_as_left() -> None:
    """All of the kernel's, the real-time ones included."""
    left = {signal.Signals[f"SIG{name}"] for name in DEFAULT["left"].split()}
    real_time = set(range(signal.SIGRTMIN, signal.SIGRTMAX + 1))
    assert {*NAMED} | real_time == signals.ENDING
    assert left | signals.ENDING == set(signal.valid_signals())


def test_names_and_reasons_are_for_the_operator() -> None:
    """Ctrl-C needs no name of a signal, others do."""
    assert signals.name(signal.SIGHUP) == "SIGHUP"
    assert signals.name(signal.SIGRTMIN) == "SIGRTMIN"
    assert signals.name(signal.SIGRTMIN + 3) == "SIGRTMIN+3"
    assert [signals.reason(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT)] == 3 * [
        "stopped by the operator"
    ]
    assert signals.reason(signal.SIGTSTP) == "suspended by the operator (Ctrl-Z)"
    assert signals.reason(signal.SIGHUP) == "the terminal or the session was closed (SIGHUP)"
    assert signals.reason(signal.SIGUSR1) == "stopped by the signal SIGUSR1"


def test_all_are_taken_in_the_block_and_everything_is_as_before_after_it() -> None:
    """Handlers and mask; a blocked signal is let in."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        signal.raise_signal(signal.SIGTERM)
        seen: list[int] = []
        with signals.taken(seen.append):
            for number in SENT:
                signal.raise_signal(number)
            for name in ("TTIN", "TTOU", "PIPE", "WINCH", "CHLD", "URG"):
                signal.raise_signal(signal.Signals[f"SIG{name}"])
        assert sorted(seen) == sorted([*SENT, signal.SIGTERM])
        assert {number: signal.getsignal(number) for number in signal.valid_signals()} == before
        assert signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@pytest.fixture
def handlers() -> Iterator[Callable[..., None]]:
    """Set handlers that end with the test."""
    before: dict[int, Any] = {}

    def set_to(number: int, handler: Any) -> None:
        before.setdefault(number, signal.signal(number, handler))

    yield set_to
    for number, old in before.items():
        signal.signal(number, old)


def test_what_the_program_around_arranged_stays(handlers: Callable[..., None]) -> None:
    """`nohup` ignores SIGHUP, a profiler has a handler of its own; Ctrl-C is taken from everybody."""
    seen: list[int] = []
    ours: list[int] = []
    handlers(signal.SIGHUP, signal.SIG_IGN)
    handlers(signal.SIGPROF, lambda number, frame: ours.append(number))
    handlers(signal.SIGALRM, signal.SIG_IGN)
    handlers(signal.SIGINT, signal.SIG_IGN)
    with signals.taken(seen.append):
        for number in (signal.SIGHUP, signal.SIGPROF, signal.SIGALRM, signal.SIGINT):
            signal.raise_signal(number)
    assert (seen, ours) == ([signal.SIGINT], [signal.SIGPROF])


def test_a_crash_report_is_not_taken_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """With faulthandler, SIGABRT says where the program aborts; without it, it is taken."""
    monkeypatch.setattr("faulthandler.is_enabled", lambda: True)
    assert signal.SIGABRT not in _taken_numbers()
    monkeypatch.setattr("faulthandler.is_enabled", lambda: False)
    monkeypatch.setattr(signal, "getsignal", lambda number: signal.SIG_DFL)
    assert signal.SIGABRT in _taken_numbers()


def _taken_numbers() -> set[int]:
    return {number for number in signals.ENDING if signals._is_ours(number)}


def test_a_handler_that_python_cannot_set_again_becomes_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was set by a library in C."""
    true_signal = signal.signal
    monkeypatch.setattr(signal, "signal", lambda number, handler: true_signal(number, handler) and None)
    with signals.taken(lambda number: None, [signal.SIGALRM]):
        pass
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


def test_in_another_thread_nothing_is_taken() -> None:
    """Python allows handlers in the main thread only."""
    found: list[Any] = []

    def look() -> None:
        with signals.taken(lambda number: None):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


def test_a_child_that_starts_is_not_ended_before_it_can_act() -> None:
    """It gets three signals while its interpreter starts, and answers them when it can."""
    program = (
        "import sys; sys.stdin.read(); from deal_hw import signals; seen = []; signals.take(seen.append); "
        "print(sorted(seen))"
    )
    with signals.held_back():
        child = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
    assert signal.SIGTERM not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGABRT):
        child.send_signal(number)
    printed, _ = child.communicate("go on")
    assert printed.split() == ["[1,", "6,", "15]"]


# The last resort of an orphan.


def test_the_last_resort_needs_no_signal_that_others_could_send() -> None:
    """A process that hangs in C, with the interpreter's lock, is killed; SIGALRM does not end it."""
    program = (
        "import ctypes, os, signal; from deal_hw import signals; "
        "from deal_hw.control.process.realtime import *; "
        "signals.take(lambda number: print(number, flush=True)); kill_self_after(0.3); "
        "os.kill(os.getpid(), signal.SIGALRM); signal.pthread_sigmask(signal.SIG_BLOCK, signals.ENDING); "
        "[ctypes.PyDLL(None).sleep(600) for _ in range(9)]"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (-9, "14\n")


def test_without_timers_nothing_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """An old library has them elsewhere; one without them is no reason to stop the passive route."""
    tried: list[str | None] = []

    def load(name: str | None, use_errno: bool = False) -> object:
        tried.append(name)
        return object()

    monkeypatch.setattr(ctypes, "CDLL", load)
    kill_self_after(1.0)
    assert tried == [None, "librt.so.1"]


def test_a_parent_that_lives_is_told_from_one_that_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """By its id; a dying one that still has it shows its state, its flags or a pending SIGKILL."""
    assert not parent_is_gone(os.getppid())
    assert parent_is_gone(os.getppid() + 1)
    stat = "77 (a) name) {} 1 1 1 0 -1 {} " + "0 " * 21 + "{} 0 0 0"

    def shows(state: str, flags: int, pending: int) -> bool:
        text = stat.format(state, flags, pending)
        monkeypatch.setattr(Path, "read_text", lambda path: text)
        return parent_is_gone(os.getppid())

    assert not shows("S", 4194560, 0)
    assert shows("Z", 4194560, 0)
    assert shows("S", 4194564, 0)
    assert shows("R", 4194560, 256)

    def missing(path: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", missing)
    monkeypatch.setattr(Path, "exists", lambda path: True)
    assert parent_is_gone(os.getppid())
    monkeypatch.setattr(Path, "exists", lambda path: False)
    assert not parent_is_gone(os.getppid())


# The control process.


class Moments(VirtualClock):
    """A clock that lets something happen whenever it is asked; the run's code asks it all the time."""

    at: Callable[[], None] = staticmethod(lambda: None)

    def now_ns(self) -> int:
        """Return the time."""
        self.at()
        return super().now_ns()


class Controlled:
    """What a control process does with a Go2 that holds its last command: handlers, loop, a virtual wire."""

    def __init__(self) -> None:
        self.bench = FakeBench(Go2OnStandRobot, mode="")
        self.clock = Moments(self.bench.clock.now_ns())
        self.bench.clock = self.bench.topics._clock = self.clock
        self.robot = Go2OnStandRobot(self.bench.topics, self.clock, support_check=False)
        self.phase, self.phases = "", list[str]()
        self.loop = ControlLoop(
            self.robot,
            HoldBehaviour(ON_STAND),
            Safety(ON_STAND),
            self.clock,
            lambda record: True,
            LoopConfig(duration_s=0.06),
            progress=self._progress,
        )
        for number in signals.ENDING:
            signal.signal(number, signal.SIG_DFL)
        self.stopper = _Stopper(os.getppid())
        self.stopper.loop = self.loop

    def _progress(self, phase: str, silence_s: float) -> None:
        self.phase = phase
        self.phases.append(phase)

    def storm(self, numbers: Sequence[int], phase: str, after: int) -> list[int]:
        """Raise signals one by one, whenever the clock is asked, from some question of a phase on.

        Returns:
            The signals that are left; the list changes.
        """
        pending, begun = list(numbers), False

        def at() -> None:
            nonlocal after, begun
            begun = begun or self.phase == phase
            after -= begun
            if after < 0 and pending:
                signal.raise_signal(pending.pop(0))

        self.clock.at = at
        return pending

    def run(self) -> LoopReport:
        """Run it; nothing may come out but the report."""
        return self.loop.run()

    @property
    def kinds(self) -> list[str]:
        """The kinds of command that the robot got, each change once."""
        found: list[str] = []
        for _, command in self.bench.device.received:
            kind = "stiff" if command.stiffness.any() else "damping"
            if found[-1:] != [kind]:
                found.append(kind)
        return found


@pytest.fixture
def controlled(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Controlled]]:
    """Make such runs; the handlers of before are back afterwards."""
    monkeypatch.setattr(control_process, "kill_self_after", lambda seconds: None)
    before = {number: signal.getsignal(number) for number in signals.ENDING}
    yield Controlled
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("phase", PHASES)
def test_every_pair_of_signals_in_every_phase_ends_with_a_damped_robot(
    controlled: Callable[[], Controlled], phase: str
) -> None:
    """Each signal first, at a moment of the phase, and all of them while it is being answered."""
    for count, first in enumerate(SENT):
        run = controlled()
        pending = run.storm([first, *SENT, first], phase, after=count % 7)
        report = run.run()
        assert len(pending) <= len(SENT), "it began"
        for number in pending:
            signal.raise_signal(number)
        assert report.passive_confirmed
        finished = phase == "making passive"
        assert report.outcome is (Outcome.FINISHED if finished else Outcome.STOPPED)
        if not finished:
            assert report.reason == signals.reason(first)
        if phase in ("connecting", "homing"):
            assert run.kinds == [], "its own controller may still have it"
        else:
            # Before its first command, an arming run leaves the robot to whoever had it.
            assert run.kinds[-1:] == ["damping"] or (phase, run.kinds) == ("arming", [])
            assert run.kinds.count("stiff") <= 1


def test_a_stop_at_any_line_of_the_loop_ends_with_a_damped_robot(
    controlled: Callable[[], Controlled],
) -> None:
    """Also in the lines that answer an error: such a stop must not leave damping to the supervisor."""
    lines, code = set[int](), ControlLoop.run.__code__

    def traced(stop_at: int) -> tuple[Controlled, LoopReport]:
        """Run it with an error while it arms, and a signal at a line."""
        run = controlled()

        def each(frame: types.FrameType, event: str, argument: object) -> Any:
            lines.add(frame.f_lineno)
            if frame.f_lineno == stop_at:
                frame.f_trace = None
                signal.raise_signal(signal.SIGHUP)
            return each

        def fail() -> None:
            if run.phase == "arming" and run.kinds:
                raise OSError("the wire broke")

        run.clock.at = fail
        # Not None afterwards: coverage traces in the same way.
        before = sys.gettrace()
        sys.settrace(lambda frame, event, argument: each if frame.f_code is code else None)
        try:
            return run, run.run()
        finally:
            sys.settrace(before)

    run, report = traced(-1)
    assert (report.outcome, report.reason, run.kinds) == (Outcome.FAILED, "the wire broke", ["damping"])
    assert len(lines) > 15
    for line in sorted(lines):
        run, report = traced(line)
        assert report.outcome in (Outcome.STOPPED, Outcome.FAILED), line
        assert "making passive" in run.phases or not run.kinds, line


def test_a_signal_before_there_is_a_loop_ends_the_process_once(controlled: Callable[[], Controlled]) -> None:
    """A second one must not come out where the first is being answered."""
    stopper = _Stopper(os.getppid())
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGHUP)
    signal.raise_signal(signal.SIGTERM)
    assert stopper.reason == signals.reason(signal.SIGHUP)


@pytest.mark.parametrize(
    ("number", "gone", "silent", "reason", "last_resort"),
    [
        (PARENT_DIED, True, False, "the supervisor died", True),
        (PARENT_DIED, False, False, "stopped by the signal SIGUSR1", False),
        (
            signal.SIGUSR2,
            False,
            True,
            "no heartbeat from the supervisor for 1 s: it is stopped, swapped",
            True,
        ),
        (signal.SIGUSR2, False, False, "stopped by the signal SIGUSR2", False),
        (signal.SIGTERM, True, False, "the supervisor died", True),
        (signal.SIGTERM, False, False, "stopped by the operator", False),
    ],
)
def test_the_supervisor_is_dead_or_silent_only_if_it_is(
    monkeypatch: pytest.MonkeyPatch,
    controlled: Callable[[], Controlled],
    number: signal.Signals,
    gone: bool,
    silent: bool,
    reason: str,
    last_resort: bool,
) -> None:
    """SIGUSR1 of another program is not taken for the death of the supervisor."""
    timers: list[float] = []
    monkeypatch.setattr(control_process, "kill_self_after", timers.append)
    monkeypatch.setattr(control_process, "parent_is_gone", lambda pid: gone)
    run = controlled()
    run.stopper.supervisor_silent, run.stopper.passive_s = silent, 30.0
    signal.raise_signal(number)
    assert run.run().reason.startswith(reason)
    assert timers == ([35.0] if last_resort else [])


# The supervisor.


class Child:
    """A control process that does not end, as the supervisor sees it."""

    pid, returncode = 1, None

    def __init__(self) -> None:
        self.got: list[int] = []

    def send_signal(self, number: int) -> None:
        """Note it."""
        self.got.append(number)

    def kill(self) -> None:
        """Note it."""
        self.got.append(signal.SIGKILL)


def test_every_pair_of_signals_asks_once_and_kills_only_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """SIGTERM and SIGHUP of an ending session are one request: the control process is damping then."""
    monkeypatch.setattr("deal_hw.control.process.supervisor.raise_priority", lambda pid: None)
    for first in SENT:
        for second in SENT:
            clock, child = VirtualClock(0), Child()
            supervisor = Supervisor(
                module="m", plan={}, port_fd=None, passive=lambda phase, already_tried: True, clock=clock
            )
            supervisor._child = child  # type: ignore[assignment]
            with signals.taken(supervisor._signalled):
                signal.raise_signal(first)
                clock.sleep_until_ns(round(PATIENCE_S * 1e9) - 1)
                signal.raise_signal(second)
                assert child.got == [first]
                clock.sleep_until_ns(round(PATIENCE_S * 1e9))
                signal.raise_signal(second)
            assert child.got == [first, signal.SIGKILL]
            assert (supervisor._stop_cause, supervisor._signal) == (
                signals.reason(first),
                signals.name(first),
            )


def test_no_signal_ends_the_supervisors_own_damping() -> None:
    """Hundreds, while the robot does not confirm for 2 s; no number of them ends the passive command."""
    bench = FakeBench(Go2OnStandRobot, mode="")
    robot = bench.armed()
    supervisor = Supervisor(module="m", plan={}, port_fd=None, passive=lambda phase, already_tried: True)
    bench.device.command, bench.device.hears = decode_low_command(STIFF), False
    bench.device.pose += 0.1  # Without a load a stiff robot looks damped.
    begin_ns = bench.clock.now_ns()
    reported: list[str] = []

    def progress(text: str, silence_s: float) -> None:
        reported.append(text)
        for number in SENT:
            signal.raise_signal(number)
        bench.device.hears = bench.clock.now_ns() - begin_ns > 2 * 10**9
        raise OSError(5, "the terminal is gone")

    with signals.taken(supervisor._signalled):
        assert make_passive(robot, bench.clock, PassiveConfig(), progress=progress)
    assert len(reported) > 10
    assert bench.device.command is not None and not bench.device.command.stiffness.any()
    assert supervisor._signal == "SIGHUP"


def test_a_signal_wakes_up_a_process_that_waits() -> None:
    """A handler runs at once, not after the wait: Python takes up the wait again afterwards."""
    clock_ns: list[int] = []
    with signals.taken(clock_ns.append, [signal.SIGALRM]):
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        select.select([], [], [], 0.05)
    assert clock_ns == [signal.SIGALRM]
