"""Compares the measured travel of a servo with the range of its joint, and puts the joint's zero into it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

from deal_hw.errors import ConfigurationError
from deal_hw.sim.robots.hardware_section import RAD, TICKS

MOST_DIFFERENCE: Final = 0.3
"""Largest share of the wider one of travel and joint range that the two do not have in common.

Arms of one kind differ: recorded jaws of SO-101 travel 2.34 rad, its published MJCF allows 1.92 rad. Another
joint's travel, and a wrong zero, differ by more.
"""
_DECIMALS: Final = 1e4
"""Ends of ranges are written with 4 decimals, a 15th of a tick, rounded inwards [1/rad]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Travel:
    """How far a servo turns.

    Attributes:
        joint: Its joint.
        id: Its id.
        direction: 1 if the joint's position grows with the servo's, else -1.
        low: Lowest position [ticks].
        high: Highest position [ticks].
        measured: Whether these are ends of a travel; False if they are just those of a turn.
    """

    joint: str
    id: int
    direction: Literal[1, -1]
    low: int
    high: int
    measured: bool = True

    def fitted(
        self, joint_range: tuple[float, float], zero: int | None, again: str
    ) -> tuple[int, tuple[float, float]]:
        """Return the zero [ticks] and the part of the joint's range that the servo reaches [rad].

        Args:
            joint_range: Lowest and highest position of the joint in its model [rad].
            zero: The zero; None: that of :func:`middle_zero`.
            again: How to measure again, for messages.

        Raises:
            ConfigurationError: The travel is not that of this joint.
        """
        low, high = joint_range
        if zero is None:
            zero = middle_zero(self.low, self.high, self.direction, joint_range)
        if not 0 <= zero < TICKS:
            raise ConfigurationError(
                f"joint {self.joint}: its MJCF's 0 would be at {zero} ticks of servo {self.id}, which counts "
                f"0 to {TICKS - 1}. Turn the horn, or set the servo's homing offset, and {again}"
            )
        if not self.measured:
            return zero, joint_range
        ends = angles(self.low, self.high, zero, self.direction)
        common = min(high, ends[1]) - max(low, ends[0])
        share = max(common, 0.0) / max(high - low, ends[1] - ends[0])
        if share < 1 - MOST_DIFFERENCE:
            raise ConfigurationError(
                f"joint {self.joint}: servo {self.id} travels from {ends[0]:.2f} to {ends[1]:.2f} rad, the "
                f"MJCF's range is {low:.2f} to {high:.2f} rad: they have {100 * share:.0f} % in common, and "
                f"{100 * (1 - MOST_DIFFERENCE):.0f} % are needed. It is another arm, its zero "
                f"is wrong, or not its whole travel was measured: {again}, or correct the MJCF's range"
            )
        low = max(low, math.ceil(ends[0] * _DECIMALS) / _DECIMALS)
        high = min(high, math.floor(ends[1] * _DECIMALS) / _DECIMALS)
        return zero, (low, high)


def angles(low: int, high: int, zero: int, direction: int) -> tuple[float, float]:
    """Return the lower and the higher position of a joint at the ends of a range of ticks [rad]."""
    ends = sorted(direction * (ticks - zero) * RAD for ticks in (low, high))
    return ends[0], ends[1]


def middle_zero(low: int, high: int, direction: int, joint_range: tuple[float, float]) -> int:
    """Return the zero with which the middles of a travel [ticks] and of a joint's range [rad] agree."""
    return round((low + high) / 2 - direction * sum(joint_range) / 2 / RAD)
