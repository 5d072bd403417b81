"""Counts refused states, with the reason and the remedy."""

from __future__ import annotations

from typing import ClassVar, Final, Literal, get_args

from deal_hw.drivers.go2.messages.simulated import UNITREE_MUJOCO, is_unitree_mujoco
from deal_hw.drivers.unitree.go_messages.layout import LOW_STATE_BYTES
from deal_hw.drivers.unitree.refusals import StateRefusals
from deal_hw.errors import FrameError, UnknownNameError

StateCheck = Literal["strict", "length"]
"""Checks that a LowState must pass: all, or all but head and checksum."""
OTHER_RULE: Final = (
    "the robot's firmware, or a simulator in its place, has another head or checksum; update deal-hw, or "
    "continue with `--state-check length`, which checks neither, so corrupted states are not detected"
)
ANOTHER_ROBOT: Final = (
    "it may be another robot type (G1 and H1 use this topic, too): choose the right robot or network"
)


def is_strict(check: StateCheck, kind: str) -> bool:
    """Return whether head and checksum are checked, too.

    Args:
        check: The check's name.
        kind: The robot, as its maker writes it.

    Raises:
        UnknownNameError: There is no such check.
    """
    if check not in get_args(StateCheck):
        raise UnknownNameError(f"check of the {kind}'s states", check, get_args(StateCheck))
    return check == "strict"


class Refusals(StateRefusals):
    """Counts refused states of a Go2."""

    robot: ClassVar[tuple[str, str]] = ("go2", "Go2")
    state_bytes: ClassVar[int] = LOW_STATE_BYTES
    rule: ClassVar[str] = "head and checksum"

    def __init__(self) -> None:
        super().__init__()
        self._simulated = 0

    def add(self, payload: bytes, error: FrameError) -> None:
        """Take a refused message and the reason."""
        super().add(payload, error)
        self._simulated += is_unitree_mujoco(payload)

    @property
    def remedy(self) -> str:
        """Remedy if every state was refused."""
        if 2 * self._simulated > self.count:
            return UNITREE_MUJOCO
        return OTHER_RULE if self.by_rule else self.of_length

    @property
    def of_length(self) -> str:
        """Remedy if the states have another length."""
        return ANOTHER_ROBOT
