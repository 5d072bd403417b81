"""Finds the servo of a bus that fell silent while others still answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from deal_hw.drivers.servo_bus.polled_robot import MISSES

SILENT_NS: Final = 50_000_000
"""A servo that answers again within this time is not absent [ns]. It is shorter than the 100 ms after which
the age of the states ends a run, so that the message names the servo."""


class AbsenceWatch:
    """Follows which servos answer a request to all of them.

    The first silent servo, in the order in which they are asked, is the absent one: those behind it may wait
    for its answer, as Dynamixel servos do. If the first of all is absent, none answers, as with a cut cable.
    So after a request without any answer, the order is reversed.

    Attributes:
        order: The ids, in the order in which to ask next.

    Args:
        ids: The servos, in their usual order.
        now_ns: Present time [ns].
    """

    def __init__(self, ids: Sequence[int], now_ns: int) -> None:
        self._ids = tuple(ids)
        self.answered(now_ns)

    def answered(self, now_ns: int) -> None:
        """Note at a time [ns] that all of them have answered."""
        self.order, self._suspect, self._count, self._since_ns = self._ids, -1, 0, now_ns

    def missed(self, answered: Sequence[int], now_ns: int) -> int | None:
        """Note which servos answered the newest request; not for a request with corrupt answers.

        Args:
            answered: Their ids.
            now_ns: Present time [ns].

        Returns:
            The servo that is absent; None while it is not known, or if all may be.
        """
        silent = next(servo for servo in self.order if servo not in answered)
        self._count = self._count + 1 if silent == self._suspect else 1
        self._suspect = silent
        if not answered:
            self.order = self.order[::-1]
        absent = self._count >= MISSES and now_ns - self._since_ns >= SILENT_NS
        return silent if absent else None
