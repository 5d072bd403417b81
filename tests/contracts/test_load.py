"""Limits on other processes grow by the time in which a busy computer keeps these waiting."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from deal_hw.clock import VirtualClock
from deal_hw.load import Load, TimeLimit, waited_s

PID = 4711


class Kernel:
    """What the kernel says of one process."""

    waited_ns = 0
    gone = False


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    """A process that has run for 2 s in 7 slices, and waited as the test says."""
    state = Kernel()
    true_read = Path.read_text

    def read(path: Path, *arguments: object, **named: object) -> str:
        if path != Path(f"/proc/{PID}/schedstat"):
            return true_read(path)
        if state.gone:
            raise FileNotFoundError(path)
        return f"2000000000 {state.waited_ns} 7\n"

    monkeypatch.setattr(Path, "read_text", read)
    return state


def test_waiting_for_a_processor_does_not_count(kernel: Kernel) -> None:
    """Only what was waited since the limit began; a process that has ended is remembered."""
    clock = VirtualClock()
    kernel.waited_ns = 5_000_000_000
    limit = TimeLimit(PID, 10.0, clock)
    clock.advance_ns(10_000_000_000)
    assert limit.left_s == 0.0
    kernel.waited_ns += 3_000_000_000
    assert limit.left_s == pytest.approx(3.0)
    kernel.gone = True
    assert (limit.waited_s, limit.left_s) == pytest.approx((3.0, 3.0))


def test_nobody_is_waited_for_without_end(kernel: Kernel) -> None:
    """Nine times its own time at most."""
    limit = TimeLimit(PID, 10.0, clock := VirtualClock())
    kernel.waited_ns = 10**15
    clock.advance_ns(99_000_000_000)
    assert limit.left_s == pytest.approx(1.0)
    clock.advance_ns(1_500_000_000)
    assert limit.left_s < 0


def test_the_message_says_whether_the_load_is_the_cause(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was granted, the load, what it means, what to do."""
    monkeypatch.setattr(Load, "now", classmethod(lambda cls: Load(15.24, 2)))
    limit = TimeLimit(PID, 10.0, VirtualClock())
    kernel.waited_ns = 36_700_000_000
    assert str(limit) == (
        "10 s of its own and 37 s in which it waited for a processor. load 15.2 on 2 processors: other "
        "programs keep this computer busy. End them, or wait until they have ended, and start again"
    )
    monkeypatch.setattr(Load, "now", classmethod(lambda cls: Load(0.4, 2)))
    kernel.waited_ns = 100_000_000
    assert "other programs are not the cause. Is the disk slow" in str(TimeLimit(PID, 10.0, VirtualClock()))


def test_without_the_kernels_word_the_limit_stays_as_it_is(kernel: Kernel) -> None:
    """No such process, or a kernel that does not count."""
    kernel.gone = True
    limit = TimeLimit(PID, 10.0, clock := VirtualClock())
    clock.advance_ns(4_000_000_000)
    assert limit.left_s == pytest.approx(6.0)
    assert waited_s(os.getpid()) >= 0.0
