"""Another master on an emulated bus: it writes goals to one servo, as a second program would."""

from __future__ import annotations

from typing import Any, Final

from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.drivers.servo_bus.servos_side import ServosSide

DOUBLED, FOREIGN = "two servos of one id", "another program writes goals"
"""Faults of a bus, in words."""
WAY_TICKS: Final = 200
"""How far it wants a servo to turn [ticks]: 0.3 rad."""


class OtherMaster:
    """Writes one goal to a servo, again and again.

    Args:
        packet: The packet that writes it.
        bus: The servo's bus.
        faults: How often, and whether the host receives its packets.
        begin_ns: Time of the first write [ns].
    """

    def __init__(self, packet: bytes, bus: ServosSide[Any], faults: BusFaults, begin_ns: int) -> None:
        self._packet, self._bus, self._shown = packet, bus, faults.foreign_on_line
        self._period_ns, self._next_ns = round(1e9 / faults.foreign_rate_hz), begin_ns

    def advance(self, now_ns: int) -> bool:
        """Write if it is time to; return whether it was."""
        if now_ns < self._next_ns:
            return False
        late = (now_ns - self._next_ns) // self._period_ns
        self._next_ns += (late + 1) * self._period_ns
        self._bus.receive_foreign(self._packet, self._shown)
        return True
