"""The planned end of a run: its request, and its progress for the recording.

A planned end brings a robot with legs to a stand and lays it down. It comes when the time is up, when the
battery is low, or by a key of the operator. A signal or a trip does not take this way: it makes the robot
passive at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from deal_hw.description import LegLimits
from deal_hw.types import RobotState

ENDING_EVENT: Final = "ending"
"""Kind of the events that mark the parts of a planned end; the first one ends the behaviour's own part."""
_END_SHARE: Final = 0.5
"""Charge at which a run ends as planned, between the charge that trips (0) and the one to arm (1). Assumed:
halfway, so that the robot has energy left to lie down."""


@dataclass(slots=True)
class PlannedEnd:
    """Carries a request to end from operator or behaviour, and tells the loop how far the end is.

    Attributes:
        reason: Why the run ends before its time, as text; "" if it does not.
        over: Whether the end is complete: the run may stop commanding.
    """

    reason: str = ""
    over: bool = False
    _steps: list[str] = field(default_factory=list)

    def request(self, reason: str) -> None:
        """Ask for the end; the first reason counts."""
        self.reason = self.reason or reason

    def note(self, step: str) -> None:
        """Note that a part of the end begins."""
        self._steps.append(step)

    def steps(self) -> list[str]:
        """Return the parts that began since the last call."""
        steps, self._steps = self._steps, []
        return steps


def battery_reason(state: RobotState, limits: LegLimits | None) -> str:
    """Return why the battery ends a run, as text; "" if it does not, or if the charge is unknown."""
    if limits is None or state.body is None:
        return ""
    least = limits.battery_low + _END_SHARE * (limits.battery - limits.battery_low)
    # An unknown charge (NaN) is not below.
    if state.body.battery < least:
        return (
            f"the battery is at {100 * state.body.battery:.0f} %, below {100 * least:g} %: the robot lies "
            "down while its motors have power; charge it"
        )
    return ""
