"""When to ask servos for a sample: they send only answers."""

from __future__ import annotations

from typing import Final

from deal_hw.clock import Clock

_MARGIN: Final = 1.25
"""Time reserved for an answer, as a multiple of its usual time."""
_SLACK_NS: Final = 500_000
"""The last request of a control period is sent this much earlier, because periods may begin late."""
_FIRST_ROUND_TRIP_NS: Final = 2_000_000


class Poller:
    """Times requests so that the last one of each control period is answered when the caller's time is over.

    So request, answer and command do not collide on a half-duplex wire, and a policy gets a fresh state.

    Attributes:
        next_ns: When the next request is due [ns].
        asked_ns: When the newest request was sent [ns].
        round_trip_ns: Time reserved for an answer, smoothed [ns].

    Args:
        clock: The clock of all times.
        period_ns: Time between two requests [ns].
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self._clock, self._period_ns = clock, period_ns
        self.restart()

    def restart(self) -> None:
        """Forget all times."""
        self.next_ns = self.asked_ns = 0
        self.round_trip_ns = self._needed_ns = _FIRST_ROUND_TRIP_NS

    def anchor(self, deadline_ns: int) -> None:
        """Move the requests so that one is answered just before a deadline [ns]."""
        self._needed_ns = self.round_trip_ns
        now_ns = self._clock.now_ns()
        left_ns = deadline_ns - self._needed_ns - _SLACK_NS - now_ns
        self.next_ns = now_ns + max(left_ns, 0) % self._period_ns

    def fits(self, deadline_ns: int) -> bool:
        """Return whether the next request can be answered before a deadline [ns]."""
        return max(self._clock.now_ns(), self.next_ns) + self._needed_ns <= deadline_ns

    def asked(self, now_ns: int, sent_ns: int) -> None:
        """Note a request.

        Args:
            now_ns: When it was begun [ns].
            sent_ns: When it was sent [ns].
        """
        self.asked_ns = sent_ns
        late = max(0, now_ns - self.next_ns) // self._period_ns
        self.next_ns += (1 + late) * self._period_ns

    def answered(self) -> None:
        """Note the answer of the newest request."""
        round_trip_ns = self._clock.now_ns() - self.asked_ns
        self.round_trip_ns += round((_MARGIN * round_trip_ns - self.round_trip_ns) / 8)

    def withdraw(self) -> None:
        """Ask again only after an answer that nobody waits for any more."""
        self.next_ns = self._clock.now_ns() + self.round_trip_ns
