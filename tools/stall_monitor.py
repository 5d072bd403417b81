"""Stall monitor: distinguishes a late program from a pause of the whole machine during a measurement.

    python tools/stall_monitor.py --seconds 60 --least-ms 1

The monitor is a process of the highest real-time priority on each processor. It sleeps for a millisecond and
reads the clock. If it wakes late, no program there could have been on time: a virtual machine was taken off
its processor, or the kernel was busy. Other tools use :func:`watch_stalls`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from deal_hw.control.process.realtime import become_realtime
from deal_hw.errors import ConfigurationError

PERIOD_NS = 1_000_000
TOP_PRIORITY = 99


@dataclass(frozen=True, slots=True)
class Pause:
    """A time in which a processor's most urgent process did not run.

    Attributes:
        processor: Its number.
        from_ns: When the monitor was due, on the machine's monotonic clock [ns].
        until_ns: When it woke [ns].
    """

    processor: int
    from_ns: int
    until_ns: int


@dataclass(slots=True)
class Account:
    """The monitor's findings; filled when the watched block ends.

    Attributes:
        pauses: All pauses, by processor and time.
    """

    pauses: list[Pause] = field(default_factory=list)

    @property
    def longest_ns(self) -> int:
        """The longest pause [ns]."""
        return max((pause.until_ns - pause.from_ns for pause in self.pauses), default=0)

    def longest_between_ns(self, from_ns: int, until_ns: int) -> int:
        """Return the longest pause that touches an interval [ns]."""
        touching = [p for p in self.pauses if p.from_ns < until_ns and p.until_ns > from_ns]
        return max((p.until_ns - p.from_ns for p in touching), default=0)

    def awake_ns(self, from_ns: int, until_ns: int) -> int:
        """Return how much of an interval lies outside every pause: there the machine ran [ns]."""
        covered, end = 0, from_ns
        for pause in sorted(self.pauses, key=lambda p: p.from_ns):
            begin = max(pause.from_ns, end)
            if (stop := min(pause.until_ns, until_ns)) > begin:
                covered += stop - begin
                end = stop
        return until_ns - from_ns - covered


@contextlib.contextmanager
def watch_stalls(least_ns: int, priority: int = TOP_PRIORITY) -> Iterator[Account]:
    """Watch all processors that this process may use, while the block runs.

    Args:
        least_ns: Shorter pauses are not noted [ns].
        priority: Priority of the monitor. With that of the watched program, the time of other real-time
            programs counts as a pause, too.

    Raises:
        ConfigurationError: SCHED_FIFO was refused.
    """
    found = Account()
    with contextlib.ExitStack() as stack:
        running = []
        for number in sorted(os.sched_getaffinity(0)):
            command = [sys.executable, __file__, f"--watch={number}", f"--least-ms={least_ns * 1e-6}"]
            command.append(f"--priority={priority}")
            process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            stack.callback(process.kill)
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise ConfigurationError(
                    "SCHED_FIFO was refused to the stall monitor: measure where it is granted"
                )
            running.append(process)
        yield found
        for process in running:
            process.kill()
            out, _ = process.communicate()
            found.pauses += [
                Pause(*map(int, line.split())) for line in out.splitlines() if line.count(" ") == 2
            ]


def watch(number: int, least_ns: int, priority: int) -> None:
    """Print each pause of a processor, for ever: number, due time and wake-up time of the monitor [ns]."""
    os.sched_setaffinity(0, {number})
    become_realtime()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        sys.exit(str(error))
    print("ready", flush=True)
    due_ns = time.monotonic_ns()
    while True:
        due_ns += PERIOD_NS
        time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        now_ns = time.monotonic_ns()
        if now_ns - due_ns > least_ns:
            print(number, due_ns, now_ns, flush=True)
            due_ns = now_ns


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to watch [s]")
    parser.add_argument("--least-ms", type=float, default=1.0, help="shorter pauses are not noted [ms]")
    parser.add_argument("--watch", type=int, help="run as the monitor of this processor, until killed")
    parser.add_argument("--priority", type=int, default=TOP_PRIORITY, help="of the monitor, 1 to 99")
    given = parser.parse_args()
    if given.watch is not None:
        watch(given.watch, round(given.least_ms * 1e6), given.priority)
    try:
        with watch_stalls(round(given.least_ms * 1e6), priority=given.priority) as seen:
            time.sleep(given.seconds)
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(
        f"{len(seen.pauses)} pauses longer than {given.least_ms:g} ms in {given.seconds:g} s, the longest "
        f"{seen.longest_ns * 1e-6:.1f} ms"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
