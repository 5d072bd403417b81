"""Commands to an emulated robot of ros2_control, and how fast its joints moved after each event."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

from deal_hw.types import FloatArray

FIRST, AGAIN, MOVES, HOLDS = "first command", "commands again", "moves", "holds"
"""Events of commands: the very first one; the first after a pause; another target; the same target again."""
PAUSE_NS: Final = 500_000_000
"""A pause of commands from which on the next one is an event [ns]."""
WATCHED_NS: Final = 1_000_000_000
"""Time after an event in which speeds count [ns]."""
_MOST_COMMANDS: Final = 1000
_MOST_EVENTS: Final = 200

Event = tuple[int, int, str]
"""Device time [ms], host time [ns], what happened."""


class Ros2CommandLog:
    """Commands and speeds of an emulated robot; tests compute from it what a fault led to.

    Targets and speeds are those of the actuated joints, (A,) [rad or m; rad/s or m/s].
    """

    def __init__(self) -> None:
        self._commands: deque[tuple[int, FloatArray, float]] = deque(maxlen=_MOST_COMMANDS)
        self._fastest: deque[list[Any]] = deque(maxlen=_MOST_EVENTS)
        self._last_ns: int | None = None
        self._kind = ""
        self._since = (0, 0)
        self._until_ns = 0

    def take(self, device_ns: int, host_ns: int, target: FloatArray, position: FloatArray) -> list[Event]:
        """Note a command that arrived, whether the controller is active or not; return the events that it is.

        A robot that is passive holds: its last target was sent at least twice. The event has the time of the
        first command with that target.

        Args:
            device_ns: Device time [ns].
            host_ns: Host clock [ns].
            target: The command, (A,).
            position: True positions then, (A,).
        """
        now, found = (device_ns // 1_000_000, host_ns), []
        if self._last_ns is None:
            found.append((*now, FIRST))
        elif device_ns - self._last_ns >= PAUSE_NS:
            found.append((*now, AGAIN))
        same = bool(self._commands) and np.array_equal(self._commands[-1][1], target)
        if self._last_ns is not None and self._kind != (kind := HOLDS if same else MOVES):
            found.append((*(self._since if same else now), kind))
            self._kind = kind
        if not same:
            self._since = now
        self._last_ns = device_ns
        self._commands.append((host_ns, target.copy(), float(np.abs(target - position).max())))
        return found

    def watch(self, device_ns: int, host_ns: int, event: str) -> None:
        """Note the largest speed after an event from now on."""
        self._fastest.append([device_ns // 1_000_000, host_ns, event, 0.0])
        self._until_ns = device_ns + WATCHED_NS

    def move(self, device_ns: int, velocity: FloatArray) -> None:
        """Take true velocities, (A,)."""
        if device_ns >= self._until_ns:
            return
        fastest = round(float(np.abs(velocity).max()), 4)
        for entry in reversed(self._fastest):
            if device_ns - entry[0] * 1_000_000 >= WATCHED_NS:
                break
            entry[3] = max(entry[3], fastest)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values.

        ``commands``: the newest ones, each with host time [ns], target, and the largest distance of the
        target from its joint at that moment. ``fastest_after``: events with the largest speed of a joint in
        the second after them.
        """
        return {
            "commands": [
                [host_ns, np.round(target, 6).tolist(), round(distance, 5)]
                for host_ns, target, distance in self._commands
            ],
            "fastest_after": [list(entry) for entry in self._fastest],
        }
