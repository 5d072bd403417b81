"""Progress of a long verb in lines, for logs and pipes without a terminal for a bar."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable
from types import TracebackType

from deal_hw.clock import Clock, MonotonicClock

EVERY_S = 10.0


def _to_stderr(line: str) -> None:
    # If the reader has ended, such as `head`, only these lines end.
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class PipedProgress:
    """Prints every ten seconds how long a verb has run and its current step.

    A thread prints, since one step may take longer than ten seconds. A pipe that nobody reads must not block
    a process that watches a robot.

    Args:
        title: The verb.
        quiet: Whether to print nothing.
        clock: Clock of the elapsed time.
        wait: Waits for the given time [s] and returns whether the verb has ended; by default until the block
        is left.
        say: Called with each line.
    """

    def __init__(
        self,
        title: str,
        quiet: bool = False,
        *,
        clock: Clock | None = None,
        wait: Callable[[float], bool] | None = None,
        say: Callable[[str], None] = _to_stderr,
    ) -> None:
        self._title, self._clock, self._say = title, clock or MonotonicClock(), say
        self._text = ""
        self._ended = threading.Event()
        self._wait = wait or self._ended.wait
        self._began_ns = self._clock.now_ns()
        self._thread = None if quiet else threading.Thread(target=self.tell, name="progress", daemon=True)

    def at(self, text: str) -> None:
        """Note the current step for the next line."""
        self._text = text

    def tell(self) -> None:
        """Print a line every ten seconds until the verb has ended."""
        while not self._wait(EVERY_S):
            passed_s = (self._clock.now_ns() - self._began_ns) * 1e-9
            self._say(f"{self._title}: {passed_s:.0f} s" + (f", {self._text}" if self._text else ""))

    def __enter__(self) -> PipedProgress:
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
