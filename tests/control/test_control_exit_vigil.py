"""The control process watches its supervisor; a claim is held by one process tree; priorities come and go."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.control.claim import LocalClaim
from deal_hw.control.handover import HEARTBEAT, StatusReceiver, StatusSender, socket_pair
from deal_hw.control.realtime import priority
from deal_hw.control.vigil import SUPERVISOR_SILENCE_S, SupervisorVigil
from deal_hw.errors import PortBusyError

SILENCE_S = 0.02
PATIENCE_S = 20.0


class Rig:
    """A vigil, its supervisor's end of the channel, and a clock that moves when told."""

    def __init__(self) -> None:
        self.clock = VirtualClock(10**12)
        self._ends = socket_pair()
        self.supervisor = StatusReceiver(self._ends[1])
        self.silent = threading.Event()
        self.calls = 0
        self.vigil = SupervisorVigil(StatusSender(self._ends[0]), self.clock, self._on_silence, SILENCE_S)

    def _on_silence(self) -> None:
        self.calls += 1
        self.silent.set()

    def words(self) -> list[str]:
        """Wait for words; the vigil is not silent meanwhile."""
        for _ in range(round(PATIENCE_S * 1e3)):
            if words := self.vigil.words():
                return words
            assert not self.silent.wait(0.001)
        raise AssertionError("the words did not come")

    def close(self) -> None:
        """The supervisor is gone."""
        self.supervisor.close()
        self.vigil._thread.join(PATIENCE_S)
        assert not self.vigil._thread.is_alive()
        self._ends[0].close()


def test_words_are_kept_and_heartbeats_left_out() -> None:
    """In order, once; the channel's end ends the vigil without an alarm."""
    rig = Rig()
    for word in ("w", HEARTBEAT, "a", HEARTBEAT, HEARTBEAT, "s"):
        rig.supervisor.tell(word)
    rig.vigil.start()
    rig.close()
    assert rig.vigil.words() == ["w", "a", "s"]
    assert rig.vigil.words() == []
    assert rig.calls == 0


def test_a_supervisor_that_beats_is_never_taken_for_silent() -> None:
    """Time passes just short of the limit between two beats, far more than the limit in all."""
    rig = Rig()
    rig.vigil.start()
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

    rig.vigil._clock = Asked(10**12)
    rig.vigil.start()
    for _ in range(6):
        assert asked.acquire(timeout=PATIENCE_S)
    rig.close()
    assert rig.calls == 0


def test_a_supervisor_that_falls_silent_is_reported_once() -> None:
    """As soon as the limit is reached, from the last beat on."""
    rig = Rig()
    rig.supervisor.tell(HEARTBEAT)
    rig.supervisor.tell("x")
    rig.vigil.start()
    assert rig.words() == ["x"]
    rig.clock.advance_ns(round(SILENCE_S * 1e9))
    assert rig.silent.wait(PATIENCE_S)
    rig.vigil._thread.join(PATIENCE_S)
    assert not rig.vigil._thread.is_alive()
    assert rig.calls == 1
    rig.close()


def test_a_supervisor_that_never_spoke_is_reported() -> None:
    """The silence counts from the start."""
    rig = Rig()
    rig.vigil.start()
    rig.clock.advance_ns(10**12)
    assert rig.silent.wait(PATIENCE_S)
    rig.close()


def test_the_vigil_keeps_nobody_alive() -> None:
    """Its thread is a daemon; the limit is the one that docs/safety.md names."""
    rig = Rig()
    assert rig.vigil._thread.daemon
    assert SUPERVISOR_SILENCE_S == 1.0
    rig.vigil.start()
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
            "). Two programs that command one robot make it jump. End that run first (Ctrl-C in its "
            "terminal), then start this one"
        )
        with LocalClaim("zenoh on loopback:2") as other:
            assert other.fileno() != first.fileno()
    with second:
        assert second.fileno() >= 0
    second.release()


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


def test_other_errors_of_the_kernel_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a limit on descriptors: no claim, and no word of another run."""
    claim = LocalClaim("a robot")
    claim._name = b"\0" + 200 * b"x"
    with pytest.raises(OSError, match="AF_UNIX path too long"):
        claim.acquire()


# Priorities.


@pytest.mark.parametrize("children", [True, False])
def test_a_priority_holds_inside_its_block_only(children: bool) -> None:
    """Where it is granted; whether threads get it, too, is said."""
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
