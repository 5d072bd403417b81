"""Ends a run from another program: by a request, and by force where its processes are stopped or hang.

The run makes its robot passive itself, since two writers would fight. What its two processes do is seen in
``/proc`` and in the run's note, so nobody waits for a process that cannot act:

- A control process that is stopped (state T) is killed; its supervisor then acts.
- A supervisor that is stopped is continued: it has the connection, and acts as soon as it runs. It is killed
  if it stays stopped, as under a debugger, or if it hangs: if its note says nothing for too long. First its
  control process must be dead: with its supervisor dead, a control process makes the robot passive itself.

Only the standard library is imported here, so that ``deal-hw stop`` acts at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable
from typing import Final

from deal_hw.clock import Clock
from deal_hw.control.process.realtime import process_state, raise_priority
from deal_hw.control.process.run_note import FoundRun

WAKE_S: Final = 0.25
"""How long a continued supervisor may take until it runs [s]; it has real-time priority where permitted."""
ACT_S: Final = 0.5
"""How long a control process may take after the request where its supervisor hangs [s]; it takes 0.25 s at
most (measured)."""
OBEY_S: Final = 5.0
"""How long a run that neither is stopped nor hangs may take until its robot is passive [s]: it may be
repeating the passive command over a lost connection."""
TAKE_OVER_S: Final = 2.0
"""How long such a run's supervisor may take after its control process was killed, and then to die [s]."""
_POLL_S: Final = 0.01
_STOPPED, _GONE = "Tt", "ZX"
"""States of a process as the kernel shows them."""


class RunEnd:
    """The end of one run.

    Args:
        run: The run.
        clock: The machine's monotonic clock.
    """

    def __init__(self, run: FoundRun, clock: Clock) -> None:
        self._run, self._clock = run, clock
        self._pids: list[int] = []
        self._killed: set[int] = set()
        self._asked_ns = 0
        self._woken_ns: int | None = None

    def request(self) -> None:
        """Ask both processes to end; whichever acts first makes the robot passive. Never waits."""
        self._pids, self._asked_ns = self._run.holders(), self._clock.now_ns()
        _send(signal.SIGTERM, self._pids)

    def wait(self) -> bool:
        """Wait until the robot is passive or the run is dead; return whether the robot confirmed it.

        A run whose processes live on, since they may not be killed, is waited for, for nine seconds in all.
        """
        while not self._run.passive and self._force() and self._passed_s < OBEY_S + 2 * TAKE_OVER_S:
            self._clock.sleep_until_ns(self._clock.now_ns() + round(_POLL_S * 1e9))
        return bool(self._run.passive)

    def _force(self) -> bool:
        """Force what cannot act; return whether a process of the run lives."""
        states = {pid: state for pid in self._pids if (state := process_state(pid)) not in _GONE}
        if not states:
            # A control process may have been started meanwhile.
            self._pids = self._run.holders()
            return bool(self._pids)
        supervisor = states.pop(self._run.pid, "")
        hangs = bool(supervisor) and self._supervisor_hangs(supervisor)
        late = self._passed_s > OBEY_S or (hangs and self._passed_s > ACT_S)
        self._kill(pid for pid, state in states.items() if late or state in _STOPPED)
        if supervisor and supervisor in _STOPPED and self._woken_ns is None:
            self._woken_ns = self._clock.now_ns()
            _send(signal.SIGCONT, [self._run.pid])
        if not states and (hangs or self._passed_s > OBEY_S + TAKE_OVER_S):
            self._kill([self._run.pid])
        return True

    def _supervisor_hangs(self, state: str) -> bool:
        now_ns = self._clock.now_ns()
        if self._woken_ns is not None and now_ns - self._woken_ns < round(WAKE_S * 1e9):
            return False
        if state in _STOPPED:
            return self._woken_ns is not None
        return self._run.hangs(now_ns)

    def _kill(self, pids: Iterable[int]) -> None:
        wanted = set(pids) - self._killed
        # Only those that have the run's note: a number may belong to another program by now.
        for pid in wanted and wanted.intersection(self._run.holders()):
            self._killed.add(pid)
            _send(signal.SIGKILL, [pid])
            raise_priority(pid)

    @property
    def _passed_s(self) -> float:
        return (self._clock.now_ns() - self._asked_ns) * 1e-9


def _send(number: int, pids: Iterable[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)
