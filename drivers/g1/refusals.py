"""Counts refused states of a G1, with the reason and the remedy."""

from __future__ import annotations

from typing import ClassVar, Final

from deal_hw.drivers.g1.messages import LOW_STATE_BYTES
from deal_hw.drivers.unitree.refusals import StateRefusals

GO2_BYTES: Final = 1180
OTHER_RULE: Final = "the robot's firmware makes the checksum by another rule; update deal-hw"
ANOTHER_ROBOT: Final = "it may be another robot type: choose the right robot or network"
IS_GO2: Final = "they have the length of a Go2's (or an H1's or B2's): take robot `go2` if it is one"


class G1Refusals(StateRefusals):
    """Counts refused states of a G1."""

    robot: ClassVar[tuple[str, str]] = ("g1", "G1")
    state_bytes: ClassVar[int] = LOW_STATE_BYTES
    rule: ClassVar[str] = "checksum"

    @property
    def remedy(self) -> str:
        """Remedy if every state was refused."""
        return OTHER_RULE if self.by_rule else self.of_length

    @property
    def of_length(self) -> str:
        """Remedy if the states have another length."""
        return IS_GO2 if self.length == GO2_BYTES else ANOTHER_ROBOT
