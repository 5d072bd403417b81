"""Repeats the current command, for robots that need it at a higher rate than it changes."""

from __future__ import annotations

from deal_hw.clock import Clock
from deal_hw.robot import Robot


class Repeater:
    """Repeats the current command when it is due; in the loop's thread, between its cycles.

    A robot's motors hold the last command for ever, but should get it often. The same command is repeated, so
    recording and calibration have one command per cycle.

    Attributes:
        sent_ns: Time of the last sent command, new or repeated [ns]; -1 before the first.

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
        """Note that a new command was sent."""
        self.sent_ns = now_ns
        self._due_ns = now_ns + self._period_ns if self._period_ns else -1

    def stop(self) -> None:
        """Repeat nothing until the next new command."""
        self._due_ns = -1

    def wake_ns(self, deadline_ns: int) -> int:
        """Return the latest wake-up time, at most ``deadline_ns`` [ns]."""
        return deadline_ns if self._due_ns < 0 else min(deadline_ns, self._due_ns)

    def repeat_if_due(self) -> None:
        """Send the command again if it is due; missed periods are skipped."""
        now_ns = self._clock.now_ns()
        if self._due_ns < 0 or now_ns < self._due_ns:
            return
        self._robot.repeat()
        self.sent_ns = now_ns
        self._due_ns += self._period_ns * ((now_ns - self._due_ns) // self._period_ns + 1)
