"""A thread that reads a tty, so that a thread with deadlines never waits inside the tty layer."""

from __future__ import annotations

import contextlib
import os
import select
import threading

from deal_hw.clock import Clock
from deal_hw.drivers.transports.arrivals import Arrivals

_READ_SIZE = 4096


class ReadAhead:
    """Reads a descriptor in a thread of its own and keeps the bytes with their stamps.

    Linux hands received bytes to a tty through a kernel worker of ordinary priority, and ``select`` and
    ``read`` on a tty wait for that worker. On a busy machine this takes tens of milliseconds, at any priority
    of the reading process. Here only this thread waits for it. A thread that waits for the queue wakes up at
    its own deadline.

    Args:
        fd: The descriptor; stays open.
        clock: Gives the stamps.
    """

    def __init__(self, fd: int, clock: Clock) -> None:
        self._fd, self._clock = fd, clock
        self._arrived: Arrivals[tuple[int, bytes | OSError]] = Arrivals()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name="tty read-ahead", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> tuple[int, bytes | OSError] | None:
        """Return the next stamp [ns] and bytes (empty: hung up), or the error; None after the timeout."""
        try:
            arrived = self._arrived.take(timeout_s)
        except TimeoutError:
            return None
        if _is_last(arrived[1]):
            # The thread has ended: the next call must return the same error.
            self._arrived.put(arrived)
        return arrived

    def stop(self) -> None:
        """End the thread; bytes that were not taken are lost."""
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        while True:
            try:
                ready, _, _ = select.select([self._fd, self._wake_read], [], [])
                if self._wake_read in ready:
                    return
                data: bytes | OSError = os.read(self._fd, _READ_SIZE)
            except BlockingIOError:
                continue
            except OSError as error:
                data = error
            self._arrived.put((self._clock.now_ns(), data))
            if _is_last(data):
                return


def _is_last(data: bytes | OSError) -> bool:
    return not isinstance(data, bytes) or not data
