"""The queue between a reading and a waiting thread: order, time-outs, signals that raise meanwhile."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

import pytest

from deal_hw.drivers.transports.arrivals import Arrivals

pytestmark = pytest.mark.real_time


class StopError(Exception):
    """Raised by a signal handler, as the control process does while it connects."""


@pytest.fixture
def alarms() -> Iterator[None]:
    """SIGALRM raises StopError."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise StopError

    before = signal.signal(signal.SIGALRM, stop)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def test_what_came_first_is_taken_first() -> None:
    """Also where the pipe was not emptied between, and nothing is left in the end."""
    arrivals: Arrivals[int] = Arrivals()
    for number in range(3):
        arrivals.put(number)
    assert [arrivals.take(0) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(TimeoutError):
        arrivals.take(0.001)
    arrivals.put(3)
    assert arrivals.take(10) == 3


def test_the_oldest_is_dropped() -> None:
    """Of 70 000 only the last two stay; a full pipe stops nobody."""
    arrivals: Arrivals[int] = Arrivals(2)
    for number in range(70_000):
        arrivals.put(number)
    assert [arrivals.take(0), arrivals.take(0)] == [69_998, 69_999]
    with pytest.raises(TimeoutError):
        arrivals.take(0)


def test_one_who_waits_is_woken() -> None:
    """All of 2000 come over from another thread, in order."""
    arrivals: Arrivals[int] = Arrivals()

    def put_all() -> None:
        for number in range(2000):
            arrivals.put(number)

    thread = threading.Thread(target=put_all)
    thread.start()
    assert [arrivals.take(10) for _ in range(2000)] == list(range(2000))
    thread.join()


@pytest.mark.skipif(
    sys.gettrace() is not None, reason="coverage's tracer holds a lock that an exception of a signal keeps"
)
def test_a_signal_may_raise_at_any_moment(alarms: None) -> None:
    """300 waits end by it, at all places of the wait; the exception is the signal's and the queue goes on."""
    arrivals: Arrivals[int] = Arrivals()
    for number in range(300):
        with pytest.raises(StopError):
            signal.setitimer(signal.ITIMER_REAL, 1e-6 * (20 + number % 60))
            while True:
                with pytest.raises(TimeoutError):
                    arrivals.take(1e-6)
    arrivals.put(7)
    assert arrivals.take(0) == 7


def test_its_descriptors_are_closed_with_it() -> None:
    """Not before: a thread may still write."""
    before = set(os.listdir("/proc/self/fd"))
    arrivals: Arrivals[int] = Arrivals()
    assert len(set(os.listdir("/proc/self/fd")) - before) >= 2
    del arrivals
    gc.collect()
    assert set(os.listdir("/proc/self/fd")) <= before
