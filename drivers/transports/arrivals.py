"""A queue from the thread that reads a wire to the thread that waits for it with a deadline."""

from __future__ import annotations

import contextlib
import os
import select
import time
import weakref
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Arrivals(Generic[T]):
    """A queue of received items, oldest first; a signal handler may raise during a wait.

    The queues of the standard library do not allow that. In ``queue.Queue`` the exception may come while the
    lock is released; then it becomes "release unlocked lock". ``queue.SimpleQueue`` may wait for ever
    afterwards (CPython 3.11).

    Args:
        most: Largest number of kept items; beyond it the oldest is dropped. None: no limit.
    """

    def __init__(self, most: int | None = None) -> None:
        self._items: deque[T] = deque(maxlen=most)
        self._read_fd, self._write_fd = os.pipe()
        for fd in (self._read_fd, self._write_fd):
            os.set_blocking(fd, False)
            # Closed only when no thread uses it any more: its number may belong to another file then.
            weakref.finalize(self, os.close, fd)

    def put(self, item: T) -> None:
        """Add an item."""
        self._items.append(item)
        # A full pipe wakes the reader, too.
        with contextlib.suppress(BlockingIOError):
            os.write(self._write_fd, b"x")

    def take(self, timeout_s: float) -> T:
        """Return the oldest item, waiting for it; only one thread may call this.

        Raises:
            TimeoutError: Nothing arrived in time.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            with contextlib.suppress(IndexError):
                return self._items.popleft()
            if not select.select([self._read_fd], [], [], max(0.0, end_s - time.monotonic()))[0]:
                raise TimeoutError
            # Cleared before the next check of the queue, so that an item that arrives in between is not
            # missed.
            with contextlib.suppress(BlockingIOError):
                os.read(self._read_fd, 65536)
