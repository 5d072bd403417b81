"""How busy this computer is, and how long another process may take on it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from typing_extensions import Self

from deal_hw.clock import Clock

_MOST: Final = 9.0
"""Longest time of waiting for a processor that is granted, as a multiple of a process's own time."""


@dataclass(frozen=True, slots=True)
class Load:
    """How busy this computer is.

    Attributes:
        running: Mean number of threads that ran or waited for a processor in the last minute.
        processors: Processors that this process may use.
    """

    running: float
    processors: int

    @classmethod
    def now(cls) -> Self:
        """Return the present load."""
        return cls(os.getloadavg()[0], len(os.sched_getaffinity(0)))

    @property
    def high(self) -> bool:
        """Whether threads had to wait for a processor."""
        return self.running > self.processors

    def __str__(self) -> str:
        return f"load {self.running:.1f} on {self.processors} processor{'s' * (self.processors != 1)}"


class TimeLimit:
    """A limit on the time of another process that grows with the load of this computer.

    The process has some time of its own, to compute and to read files. The time in which it is ready and
    waits for a processor is granted on top, up to nine times its own: a process that a busy computer keeps
    waiting does not hang.

    Args:
        pid: The process.
        own_s: Its own time, from now on [s].
        clock: Measures the time.
    """

    def __init__(self, pid: int, own_s: float, clock: Clock) -> None:
        self._pid, self._own_s, self._clock = pid, own_s, clock
        self._begin_ns, self._before_s, self._waited_s = clock.now_ns(), waited_s(pid), 0.0

    @property
    def waited_s(self) -> float:
        """How long the process has waited for a processor, as far as that is granted [s]."""
        # Nothing is known of a process that has ended.
        self._waited_s = max(self._waited_s, waited_s(self._pid) - self._before_s)
        return min(self._waited_s, _MOST * self._own_s)

    @property
    def left_s(self) -> float:
        """The time that is left [s]; negative once it is over."""
        passed_s = (self._clock.now_ns() - self._begin_ns) * 1e-9
        return self._own_s + self.waited_s - passed_s

    def __str__(self) -> str:
        """Return what was granted, why it was not enough, and what to do."""
        waited, load = self.waited_s, Load.now()
        granted = f"{self._own_s:g} s of its own and {waited:.0f} s in which it waited for a processor"
        if load.high or waited > self._own_s:
            return (
                f"{granted}. {load}: other programs keep this computer busy. End them, or wait until they "
                "have ended, and start again"
            )
        return (
            f"{granted}. {load}: other programs are not the cause. Is the disk slow, or the memory full "
            "(swap)? Then start again"
        )


def waited_s(pid: int) -> float:
    """Return how long a process's main thread has been ready and waited for a processor [s].

    0 where the kernel does not say it, or there is no such process.
    """
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError, ValueError):
        return 0.0
