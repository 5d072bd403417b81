"""Finds the servo of a bus that fails while the others still answer: it is silent, or two have its id."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from deal_hw.drivers.servo_bus.polled_robot import MISSES

SILENT_NS: Final = 50_000_000
"""A servo that answers again within this time is not absent [ns]. It is shorter than the 100 ms after which
the age of the states ends a run, so that the message names the servo."""
QUIET_NS: Final = 10_000_000_000
"""A line without corrupt answers of other servos for this long has no noise that hits them all [ns]."""


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


class CollisionWatch:
    """Follows whose answers are corrupt in requests to all servos.

    Two servos with one id answer at the same time, and spoil each other's answers alone. Noise spoils those
    of all servos, now of one, now of another.

    Args:
        ids: The servos, in their usual order.
        now_ns: Present time [ns].
    """

    def __init__(self, ids: Sequence[int], now_ns: int) -> None:
        self._ids = tuple(ids)
        self._spoilt_ns: dict[int, int] = {}
        self.answered(now_ns)

    def answered(self, now_ns: int) -> None:
        """Note at a time [ns] that all of them have answered soundly."""
        self._suspect, self._count, self._since_ns = -1, 0, now_ns

    def missed(self, answered: Sequence[int], now_ns: int) -> int | None:
        """Note a request with corrupt answers.

        Args:
            answered: The ids of those that answered soundly, once each.
            now_ns: Present time [ns].

        Returns:
            The servo whose id two have; None while it is not known.
        """
        spoilt = next((servo for servo in self._ids if servo not in answered), -1)
        self._count = self._count + 1 if spoilt == self._suspect else 1
        self._suspect, self._spoilt_ns[spoilt] = spoilt, now_ns
        if spoilt < 0 or self._count < MISSES or now_ns - self._since_ns < SILENT_NS:
            return None
        others = [at_ns for servo, at_ns in self._spoilt_ns.items() if servo != spoilt]
        return None if any(now_ns - at_ns < QUIET_NS for at_ns in others) else spoilt
