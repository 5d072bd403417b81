"""Another master on an emulated bus: it writes goals to one servo, as a second program would."""

from __future__ import annotations

from typing import Any, Final

from deal_hw.drivers.servo_arm.emulated_families import EmulatedJoint
from deal_hw.drivers.servo_bus.servos_side import ServosSide
from deal_hw.sim.robots.hardware_section import TICKS

WAY_TICKS: Final = 200
"""How far it wants the servo to turn, towards the middle of its ticks: 0.3 rad."""


class OtherMaster:
    """Writes one goal to a servo, again and again.

    Args:
        joint: The servo.
        bus: Its bus.
        rate_hz: Writes per second.
        shown: Whether the host receives its packets.
        begin_ns: Time of the first write [ns].
    """

    def __init__(
        self, joint: EmulatedJoint, bus: ServosSide[Any], rate_hz: float, *, shown: bool, begin_ns: int
    ) -> None:
        goal = joint.goal
        way = WAY_TICKS if goal < TICKS // 2 else -WAY_TICKS
        self._packet, self._bus, self._shown = joint.goal_packet(goal + way), bus, shown
        self._period_ns, self._next_ns = round(1e9 / rate_hz), begin_ns

    def advance(self, now_ns: int) -> bool:
        """Write if it is time to; return whether it was."""
        if now_ns < self._next_ns:
            return False
        late = (now_ns - self._next_ns) // self._period_ns
        self._next_ns += (late + 1) * self._period_ns
        self._bus.receive_foreign(self._packet, self._shown)
        return True
