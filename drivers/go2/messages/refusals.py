"""Counts refused states, with the reason and the remedy."""

from __future__ import annotations

from collections import Counter
from typing import Final, Literal

from deal_hw.drivers.go2.messages.layout import LOW_STATE_BYTES
from deal_hw.drivers.go2.messages.simulated import UNITREE_MUJOCO, is_unitree_mujoco
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.errors import FrameError, ProtocolError, VersionMismatchError, WrongDeviceError

StateCheck = Literal["strict", "length"]
"""Checks that a LowState must pass: all, or all but head and checksum."""
OTHER_RULE: Final = (
    "the robot's firmware, or a simulator in its place, has another head or checksum; update deal-hw, or "
    "continue with `--state-check length`, which checks neither, so corrupted states are not detected"
)
ANOTHER_ROBOT: Final = (
    "it may be another robot type (G1 and H1 use this topic, too): choose the right robot or network"
)


class Refusals:
    """Counts refused states.

    Attributes:
        count: Number of refused states.
        first: Reason of the first refusal, as text; "" before.
    """

    def __init__(self) -> None:
        self.count, self.first = 0, ""
        self._ruled = self._simulated = 0
        self._lengths: Counter[int] = Counter()

    def add(self, payload: bytes, error: FrameError) -> None:
        """Take a refused message and the reason."""
        self.count += 1
        self.first = self.first or str(error)
        self._lengths[len(payload)] += 1
        self._ruled += len(payload) == LOW_STATE_BYTES and payload[:4] == CDR_HEADER
        self._simulated += is_unitree_mujoco(payload)

    @property
    def by_rule(self) -> bool:
        """Whether most refused states have a Go2's length and encoding: then head or checksum differ."""
        return 2 * self._ruled > self.count

    @property
    def remedy(self) -> str:
        """Remedy if every state was refused."""
        if 2 * self._simulated > self.count:
            return UNITREE_MUJOCO
        return OTHER_RULE if self.by_rule else ANOTHER_ROBOT

    def error(self) -> ProtocolError:
        """Return the finding if every state was refused."""
        if self.by_rule:
            return VersionMismatchError(
                f"go2: {self._ruled} states have the right length, but none has the right head and "
                f"checksum (the first: {self.first}): {self.remedy}"
            )
        length = self._lengths.most_common(1)[0][0]
        if length != LOW_STATE_BYTES:
            return WrongDeviceError(
                f"go2: the messages on {topics.LOW_STATE} have {length} bytes, but those of a Go2 "
                f"{LOW_STATE_BYTES}: {ANOTHER_ROBOT}"
            )
        return WrongDeviceError(
            f"go2: the messages on {topics.LOW_STATE} are no states of a Go2: {self.first}"
        )
