"""The control process watches its supervisor; a claim is held by one process tree; priorities come and go."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.process.channel import HEARTBEAT, StatusReceiver, StatusSender, socket_pair
from deal_hw.control.process.claim import LocalClaim
from deal_hw.control.process.realtime import priority
from deal_hw.control.process.watchdog import SUPERVISOR_SILENCE_S, SupervisorWatchdog
from deal_hw.errors import PortBusyError

pytestmark = pytest.mark.real_time

SILENCE_S = 0.02
PATIENCE_S = 20.0


class Rig:
    """A watchdog, its supervisor's end of the channel, and a clock that moves on request."""

    def __init__(self) -> None:
        self.clock = VirtualClock(10**12)
        self._ends = socket_pair()
        self.supervisor = StatusReceiver(self._ends[1])
        self.silent = threading.Event()
        self.calls = 0
        self.watchdog = SupervisorWatchdog(
            StatusSender(self._ends[0]), self.clock, self._on_silence, SILENCE_S
        )

    def _on_silence(self) -> None:
        self.calls += 1
        self.silent.set()

    def words(self) -> list[str]:
        """Wait for words; the watchdog is not silent meanwhile."""
        for _ in range(round(PATIENCE_S * 1e3)):
            if words := self.watchdog.messages():
                return words
            assert not self.silent.wait(0.001)
        raise AssertionError("the words did not come")

    def close(self) -> None:
        """The supervisor is gone."""
        self.supervisor.close()
        self.watchdog._thread.join(PATIENCE_S)
        assert not self.watchdog._thread.is_alive()
        self._ends[0].close()


def test_words_are_kept_and_heartbeats_left_out() -> None:
    """In order, once; the channel's end ends the watchdog without an alarm."""
    rig = Rig()
    for word in ("w", HEARTBEAT, "a", HEARTBEAT, HEARTBEAT, "s"):
        rig.supervisor.tell(word)
    rig.watchdog.start()
    rig.close()
    assert rig.watchdog.messages() == ["w", "a", "s"]
    assert rig.watchdog.messages() == []
    assert rig.calls == 0


def test_a_supervisor_that_beats_is_never_taken_for_silent() -> None:
    """Time passes just short of the limit between two beats, far more than the limit in all."""
    rig = Rig()
    rig.watchdog.start()
    for _ in range(10):
        rig.clock.advance_ns(round(SILENCE_S * 1e9) - 1)
        rig.supervisor.tell(HEARTBEAT)
        rig.supervisor.tell("x")
        assert rig.words() == ["x"]
    rig.close()
    assert rig.calls == 0


def test_a_wait_that_ends_early_is_taken_up_again() -> None:
    """The wait is the kernel's, the time is the clock's: only the clock decides."""
    rig = Rig()
    asked = threading.Semaphore(0)

    class Asked(VirtualClock):
        def now_ns(self) -> int:
            """Count who asks."""
            asked.release()
            return super().now_ns()

    rig.watchdog._clock = Asked(10**12)
    rig.watchdog.start()
    for _ in range(6):
        assert asked.acquire(timeout=PATIENCE_S)
    rig.close()
    assert rig.calls == 0


def test_the_kernels_wait_is_what_is_left_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread with a real-time priority must not spin; where nothing is left, it only looks."""
    rig = Rig()
    waits: list[float] = []

    class Scripted(VirtualClock):
        times_ms = iter((0, 5, 5, 30, 30))

        def now_ns(self) -> int:
            """Begin; what is left; not silent yet; what is left; silent."""
            return next(self.times_ms) * 10**6

    def wait(read: list[Any], write: list[Any], other: list[Any], timeout_s: float) -> tuple[list[Any], ...]:
        waits.append(timeout_s)
        return [], [], []

    monkeypatch.setattr("deal_hw.control.process.watchdog.select.select", wait)
    rig.watchdog._clock = Scripted()
    rig.watchdog.start()
    assert rig.silent.wait(PATIENCE_S)
    rig.close()
    assert waits == pytest.approx([0.015, 0.0])


def test_a_supervisor_that_falls_silent_is_reported_once() -> None:
    """As soon as the limit is reached, from the last beat on."""
    rig = Rig()
    rig.supervisor.tell(HEARTBEAT)
    rig.supervisor.tell("x")
    rig.watchdog.start()
    assert rig.words() == ["x"]
    rig.clock.advance_ns(round(SILENCE_S * 1e9))
    assert rig.silent.wait(PATIENCE_S)
    rig.watchdog._thread.join(PATIENCE_S)
    assert not rig.watchdog._thread.is_alive()
    assert rig.calls == 1
    rig.close()


def test_a_supervisor_that_never_spoke_is_reported() -> None:
    """The silence counts from the start."""
    rig = Rig()
    rig.watchdog.start()
    rig.clock.advance_ns(10**12)
    assert rig.silent.wait(PATIENCE_S)
    rig.close()


def test_the_watchdog_keeps_nobody_alive() -> None:
    """Its thread is a daemon, with a name for debuggers."""
    rig = Rig()
    assert rig.watchdog._thread.daemon
    assert rig.watchdog._thread.name == "supervisor watchdog"
    rig.watchdog.start()
    rig.close()


def test_the_limit_is_the_one_that_the_docs_name() -> None:
    """docs/explanation/safety.md says 1 s."""
    rig = Rig()
    watchdog = SupervisorWatchdog(rig.watchdog._status, rig.clock, rig._on_silence)
    assert watchdog._silence_ns == round(SUPERVISOR_SILENCE_S * 1e9) == 10**9
    rig.watchdog.start()
    rig.close()


def test_words_that_nobody_takes_are_forgotten() -> None:
    """The newest 256 are kept."""
    rig = Rig()
    rig.watchdog._words.extend(map(str, range(300)))
    assert rig.watchdog.messages() == list(map(str, range(44, 300)))
    rig.watchdog.start()
    rig.close()


# The claim on this computer.


def test_a_claim_is_exclusive_and_says_who_holds_it() -> None:
    """The second is refused with the first one's process; another robot's is free; once released, all are."""
    first, second = LocalClaim("zenoh on loopback:1"), LocalClaim("zenoh on loopback:1")
    with first:
        with pytest.raises(PortBusyError) as raised:
            second.acquire()
        text = str(raised.value)
        assert text.startswith(f"zenoh on loopback:1: the robot is in use by process {os.getpid()} (")
        assert text.endswith(
            "). Two programs that command one robot make it jump. End the other run (Ctrl-C in its "
            "terminal), then start this one"
        )
        with LocalClaim("zenoh on loopback:2") as other:
            assert other.fileno() != first.fileno()
    with second:
        assert second.fileno() >= 0
    second.release()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["", "/a/b/third", b"odd\xff", "fifth", "sixth"], "third odd\N{REPLACEMENT CHARACTER} fifth"),
        (["x" * 200], "x" * 200),
    ],
)
def test_a_claim_says_with_what_command_it_is_held(
    arguments: list[str | bytes], words: str, tmp_path: Path
) -> None:
    """Six words at most, without their folders, 120 letters in all; an empty word counts and is not shown."""
    holder = tmp_path / "holder.py"
    holder.write_text(
        "import sys\nfrom deal_hw.control.process.claim import LocalClaim\n"
        "with LocalClaim('a robot'):\n    print(flush=True)\n    sys.stdin.read()\n"
    )
    command = [sys.executable, str(holder), *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline() == b"\n"
        with pytest.raises(PortBusyError) as raised:
            LocalClaim("a robot").acquire()
        child.communicate()
    shown = f"{Path(sys.executable).name} holder.py {words}"[:120]
    assert str(raised.value).startswith(f"a robot: the robot is in use by process {child.pid} ({shown}). Two")


def test_a_claim_that_is_not_held_has_no_descriptor() -> None:
    """A mistake in the program, not in the world."""
    with pytest.raises(RuntimeError, match=r"^the claim is not held$"):
        LocalClaim("x").fileno()


def test_many_that_are_refused_all_hear_by_whom() -> None:
    """Nobody takes their questions from the queue; none waits, and none is left without an answer."""
    with LocalClaim("a robot") as claim:
        assert claim._name.startswith(b"\0deal-hw/claim/")
        for _ in range(20):
            with pytest.raises(PortBusyError, match=f"in use by process {os.getpid()} "):
                LocalClaim("a robot").acquire()


def test_anyone_can_ask_whether_a_claim_is_held() -> None:
    """However often; nobody takes the questions from the queue, and a full one is an answer, too."""
    claim, asker = LocalClaim("an emulator's port"), LocalClaim("an emulator's port")
    assert not asker.held
    with claim:
        assert all(asker.held for _ in range(300)) and claim.held
        assert not LocalClaim("another port").held
    assert not asker.held


def test_a_child_keeps_the_claim_when_its_parent_is_gone() -> None:
    """It still has to make the robot passive; when it has ended, the kernel gives the name back."""
    claim = LocalClaim("a robot")
    claim.acquire()
    child = subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"],
        stdin=subprocess.PIPE,
        pass_fds=[claim.fileno()],
    )
    claim.release()
    with pytest.raises(PortBusyError):
        LocalClaim("a robot").acquire()
    child.communicate()
    with LocalClaim("a robot"):
        pass


def test_a_holder_that_cannot_be_asked_is_another_run() -> None:
    """The name is taken, and nobody listens."""
    claim = LocalClaim("a robot")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.bind(claim._name)
        with pytest.raises(PortBusyError, match="in use by another run"):
            claim.acquire()


def test_a_holder_with_a_full_queue_is_not_waited_for() -> None:
    """So many ask it at once that the kernel lets no more: then it is another run."""
    claim = LocalClaim("a robot")
    texts: list[str] = []

    def ask() -> None:
        with pytest.raises(PortBusyError) as raised:
            claim.acquire()
        texts.append(str(raised.value))

    with contextlib.ExitStack() as opened:
        busy = opened.enter_context(socket.socket(socket.AF_UNIX))
        busy.bind(claim._name)
        busy.listen(0)
        with contextlib.suppress(BlockingIOError):
            while True:
                asking = opened.enter_context(socket.socket(socket.AF_UNIX))
                asking.setblocking(False)
                asking.connect(claim._name)
        thread = threading.Thread(target=ask, daemon=True)
        thread.start()
        thread.join(PATIENCE_S)
        assert len(texts) == 1 and "in use by another run. Two" in texts[0]


def test_other_errors_of_the_kernel_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a limit on descriptors: no claim, and no word of another run."""
    claim = LocalClaim("a robot")
    claim._name = b"\0" + 200 * b"x"
    with pytest.raises(OSError, match="AF_UNIX path too long"):
        claim.acquire()


# Priorities.


@pytest.mark.parametrize("children", [True, False])
def test_a_priority_holds_inside_its_block_only(children: bool) -> None:
    """Where it is granted; whether threads get it, too, is reported."""
    before = os.sched_getscheduler(0)
    found: list[int] = []
    with priority(7, children=children, lock=True):
        inside = os.sched_getscheduler(0)
        if inside & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
            pytest.skip("SCHED_FIFO is not granted here")
        assert os.sched_getparam(0).sched_priority == 7
        thread = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
    assert os.sched_getscheduler(0) == before
    assert found == [os.SCHED_FIFO if children else os.SCHED_OTHER]
