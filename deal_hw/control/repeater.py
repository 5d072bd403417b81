"""Sends the command in force again and again, for robots that want it faster than it changes."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.robot import Robot


class Repeater:
    """Knows when the command in force is due again; in the same thread as the loop, between its cycles.

    A robot's drives follow the last command for ever, but want to hear it often: what is repeated is the same
    command, so that recording and calibration see one command a cycle.

    Attributes:
        sent_ns: When a command was last sent, new or again [ns]; -1 before the first.

    Args:
        robot: The robot; ``description.repeat_rate_hz`` 0 means that nothing is repeated.
        clock: The loop's clock.
    """

    def __init__(self, robot: Robot, clock: Clock) -> None:
        rate_hz = robot.description.repeat_rate_hz
        self._robot, self._clock = robot, clock
        self._period_ns = round(1e9 / rate_hz) if rate_hz > 0 else 0
        self._due_ns = -1
        self.sent_ns = -1

    def note_sent(self, now_ns: int) -> None:
        """A new command went out."""
        self.sent_ns = now_ns
        self._due_ns = now_ns + self._period_ns if self._period_ns else -1

    def stop(self) -> None:
        """Repeat nothing until the next new command."""
        self._due_ns = -1

    def wake_ns(self, deadline_ns: int) -> int:
        """Return when to wake up at the latest, at most ``deadline_ns`` [ns]."""
        return deadline_ns if self._due_ns < 0 else min(deadline_ns, self._due_ns)

    def repeat_if_due(self) -> None:
        """Send the command again if its time has come; periods that were missed are skipped."""
        now_ns = self._clock.now_ns()
        if self._due_ns < 0 or now_ns < self._due_ns:
            return
        self._robot.repeat()
        self.sent_ns = now_ns
        self._due_ns += self._period_ns * ((now_ns - self._due_ns) // self._period_ns + 1)
