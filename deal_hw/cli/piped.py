"""Progress of a long verb in lines, for logs and pipes without a terminal for a bar."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

from deal_hw.clock import Clock, MonotonicClock

EVERY_S = 10.0


def _to_stderr(line: str) -> None:
    # If the reader has ended, such as `head`, only these lines end.
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class PipedProgress:
    """Prints how long a verb has run and its current step: every ten seconds, if the step has changed.

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
        self._title, self._clock = title, clock or MonotonicClock()
        self._say = (lambda line: None) if quiet else say
        self._text = ""
        self._ended = threading.Event()
        self._wait = wait or self._ended.wait
        self._began_ns = self._clock.now_ns()
        self._thread = None if quiet else threading.Thread(target=self.tell, name="progress", daemon=True)

    def at(self, text: str) -> None:
        """Note the current step for the next line."""
        self._text = text

    def say(self, text: str) -> None:
        """Print a line now."""
        self._say(f"{self._title}: {text}")

    def tell(self) -> None:
        """Print the current step every ten seconds, once each, until the verb has ended."""
        printed = None
        while not self._wait(EVERY_S):
            text = self._text
            if text == printed:
                continue
            printed = text
            passed_s = (self._clock.now_ns() - self._began_ns) * 1e-9
            self.say(f"{passed_s:.0f} s" + (f", {text}" if text else ""))

    def __enter__(self) -> PipedProgress:
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()


@dataclass(frozen=True, kw_only=True)
class Quiet:
    """What only the command line has."""

    quiet: bool = False
    """Print nothing but errors."""


def is_quiet(settings: object) -> bool:
    """Return whether only errors are printed."""
    return isinstance(settings, Quiet) and settings.quiet
