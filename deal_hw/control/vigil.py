"""The control process watches its supervisor: one that is stopped or hangs could not act for the operator."""

from __future__ import annotations

import select
import threading
from collections import deque
from collections.abc import Callable

from deal_hw.clock import Clock
from deal_hw.control.process_channel import HEARTBEAT, StatusSender

SUPERVISOR_SILENCE_S = 1.0
"""A supervisor that has said nothing for this long is taken for stopped [s]. It beats every 50 ms; without a
real-time priority a busy machine may hold it up for some 0.4 s."""


class SupervisorVigil:
    """Listens to the supervisor in a thread, because the control process may wait for the robot for seconds.

    Args:
        status: The channel to the supervisor.
        clock: Measures the silence.
        on_silence: Called once, in the thread, where the supervisor is silent for too long.
        silence_s: How long that is [s].
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
        self._thread = threading.Thread(target=self._listen, name="supervisor vigil", daemon=True)

    def start(self) -> None:
        """Listen from now on; the thread has the priority of the one that calls."""
        self._thread.start()

    def messages(self) -> list[str]:
        """Return what the supervisor told since the last call, heartbeats left out."""
        return [self._words.popleft() for _ in range(len(self._words))]

    def _listen(self) -> None:
        heard_ns = self._clock.now_ns()
        while True:
            left_ns = heard_ns + self._silence_ns - self._clock.now_ns()
            ready = select.select([self._status], [], [], max(left_ns, 0) * 1e-9)[0]
            if words := self._status.heard():
                heard_ns = self._clock.now_ns()
                self._words.extend(word for word in words if word != HEARTBEAT)
            elif ready:
                # Closed: the supervisor is dead, and the kernel says so by a signal.
                return
            elif self._clock.now_ns() - heard_ns >= self._silence_ns:
                self._on_silence()
                return
