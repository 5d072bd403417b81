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
    """What came, oldest first. A signal handler may raise while somebody waits.

    The queues of the standard library do not allow that. In ``queue.Queue`` such an exception may come while
    the lock is released, and ends as "release unlocked lock". After one, ``queue.SimpleQueue`` may wait for
    ever (CPython 3.11).

    Args:
        most: How many are kept; then the oldest is dropped. None: all.
    """

    def __init__(self, most: int | None = None) -> None:
        self._items: deque[T] = deque(maxlen=most)
        self._read_fd, self._write_fd = os.pipe()
        for fd in (self._read_fd, self._write_fd):
            os.set_blocking(fd, False)
            # Not before the last thread has let go of it: its number may belong to another file then.
            weakref.finalize(self, os.close, fd)

    def put(self, item: T) -> None:
        """Add what came."""
        self._items.append(item)
        # A full pipe wakes the reader, too.
        with contextlib.suppress(BlockingIOError):
            os.write(self._write_fd, b"x")

    def take(self, timeout_s: float) -> T:
        """Return the oldest, waiting for it; only one thread may take.

        Raises:
            TimeoutError: Nothing came in time.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            with contextlib.suppress(IndexError):
                return self._items.popleft()
            if not select.select([self._read_fd], [], [], max(0.0, end_s - time.monotonic()))[0]:
                raise TimeoutError
            # Cleared before the next look, so that nothing that comes in between is missed.
            with contextlib.suppress(BlockingIOError):
                os.read(self._read_fd, 65536)
