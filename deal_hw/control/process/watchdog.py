"""The control process watches its supervisor, since a stopped or hanging one cannot act for the operator."""

from __future__ import annotations

import select
import threading
from collections import deque
from collections.abc import Callable

from deal_hw.clock import Clock
from deal_hw.control.process.channel import HEARTBEAT, StatusSender

SUPERVISOR_SILENCE_S = 1.0
"""A supervisor without a heartbeat for this long counts as stopped [s]. It sends one every 50 ms; without
real-time priority a busy machine may delay it by about 0.4 s."""


class SupervisorWatchdog:
    """Listens to the supervisor in a thread, because the control process may wait seconds for the robot.

    Args:
        status: The channel to the supervisor.
        clock: Measures the silence.
        on_silence: Called once, in the thread, after the supervisor was silent for ``silence_s``.
        silence_s: Longest allowed silence [s].
    """

    def __init__(
        self,
        status: StatusSender,
        clock: Clock,
        on_silence: Callable[[], None],
        silence_s: float = SUPERVISOR_SILENCE_S,
    ) -> None:
        self._status, self._clock, self._on_silence = status, clock, on_silence
        self._silence_ns = round(silence_s * 1e9)
        self._words: deque[str] = deque(maxlen=256)
        self._thread = threading.Thread(target=self._listen, name="supervisor watchdog", daemon=True)

    def start(self) -> None:
        """Start to listen; the thread has the caller's priority."""
        self._thread.start()

    def messages(self) -> list[str]:
        """Return the supervisor's messages since the last call, without heartbeats."""
        return [self._words.popleft() for _ in range(len(self._words))]

    def _listen(self) -> None:
        heard_ns = self._clock.now_ns()
        while True:
            left_ns = heard_ns + self._silence_ns - self._clock.now_ns()
            ready = select.select([self._status], [], [], max(left_ns, 0) * 1e-9)[0]
            if words := self._status.received():
                heard_ns = self._clock.now_ns()
                self._words.extend(word for word in words if word != HEARTBEAT)
            elif ready:
                # Closed: the supervisor is dead, which the kernel reports by a signal.
                return
            elif self._clock.now_ns() - heard_ns >= self._silence_ns:
                self._on_silence()
                return
