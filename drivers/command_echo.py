"""Which command was in force when a state was sensed: found where it is not reported, checked where it is."""

from __future__ import annotations

from collections import deque
from typing import Final

OFFSET_WINDOW_NS: Final = 1_000_000_000
"""Length of a window [ns]; the offset is the smallest of the present window and the one before.
An older offset would be wrong after a pause of the robot's computer: its clock then stays behind."""


_SIGNS: Final = 2
"""States with another program's command after which it is known."""


class ClockOffset:
    """Host clock minus robot clock, by the fastest recent message.

    A state may wait on the network or until it is read, and then its offset is too large. The smallest one is
    the best estimate.

    Attributes:
        offset_ns: The offset [ns].
    """

    def __init__(self) -> None:
        self.offset_ns = self._recent_ns = self._former_ns = self._window_ns = 0
        self._first = True

    def take(self, receive_ns: int, device_ns: int) -> None:
        """Take the time of a state by both clocks [ns]."""
        offset = receive_ns - device_ns
        if self._first or receive_ns - self._window_ns > OFFSET_WINDOW_NS:
            self._former_ns = offset if self._first else self._recent_ns
            self._recent_ns, self._window_ns, self._first = offset, receive_ns, False
        self._recent_ns = min(self._recent_ns, offset)
        self.offset_ns = min(self._former_ns, self._recent_ns)


class NumberWatch:
    """Notices that a robot follows a command of another program, by the number that its states report.

    Our numbers grow, and a robot never goes back to an older one. One state may be corrupt; the second with a
    number that cannot be ours is another program's.

    Attributes:
        foreign: That number; -1 while all are ours.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Expect no command; numbers are judged from the first one that is sent."""
        self.foreign = self._sent = self._shown = -1
        self._odd = 0

    def sent(self, number: int) -> None:
        """Note that a command was sent."""
        self._sent = number

    def shown(self, number: int) -> None:
        """Take the number of the command in force in a state; -1 for none."""
        if self._sent < 0 or number < 0:
            return
        if self._shown <= number <= self._sent:
            self._shown = number
            return
        self._odd += 1
        if self._odd >= _SIGNS and self.foreign < 0:
            self.foreign = number


class CommandEcho:
    """Finds which command was in force when a state was sensed, if the robot does not report it."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self._sent: deque[tuple[int, int]] = deque(maxlen=4096)
        self._in_force: tuple[int, int] | None = None

    def note(self, sequence: int, stamp_ns: int) -> None:
        """Note that a command was sent at a time of the host's clock [ns]."""
        self._sent.append((sequence, stamp_ns))

    def at(self, device_ns: int, offset_ns: int) -> tuple[int, int]:
        """Return number and age [ns] of the command in force at a time of the robot's clock; (-1, -1): none.

        The send time of a command by the robot's clock is computed once, so that its age grows with that
        clock.
        """
        while self._sent and self._sent[0][1] - offset_ns < device_ns:
            sequence, stamp_ns = self._sent.popleft()
            self._in_force = sequence, stamp_ns - offset_ns
        if self._in_force is None:
            return -1, -1
        return self._in_force[0], device_ns - self._in_force[1]
