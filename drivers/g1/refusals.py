"""Counts refused states of a G1, with the reason and the remedy."""

from __future__ import annotations

from collections import Counter
from typing import Final

from deal_hw.drivers.g1.messages import LOW_STATE_BYTES
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.errors import FrameError, ProtocolError, VersionMismatchError, WrongDeviceError

GO2_BYTES: Final = 1180
OTHER_RULE: Final = "the robot's firmware makes the checksum by another rule; update deal-hw"
ANOTHER_ROBOT: Final = "it may be another robot type: choose the right robot or network"
IS_GO2: Final = "they have the length of a Go2's (or an H1's or B2's): take robot `go2` if it is one"


class G1Refusals:
    """Counts refused states.

    Attributes:
        count: Number of refused states.
        first: Reason of the first refusal, as text; "" before.
    """

    def __init__(self) -> None:
        self.count, self.first = 0, ""
        self._ruled = 0
        self._lengths: Counter[int] = Counter()

    def add(self, payload: bytes, error: FrameError) -> None:
        """Take a refused message and the reason."""
        self.count += 1
        self.first = self.first or str(error)
        self._lengths[len(payload)] += 1
        self._ruled += len(payload) == LOW_STATE_BYTES and payload[:4] == CDR_HEADER

    @property
    def by_rule(self) -> bool:
        """Whether most refused states have a G1's length and encoding: then the checksum differs."""
        return 2 * self._ruled > self.count

    @property
    def remedy(self) -> str:
        """Remedy if every state was refused."""
        if self.by_rule:
            return OTHER_RULE
        return IS_GO2 if self._lengths.most_common(1)[0][0] == GO2_BYTES else ANOTHER_ROBOT

    def error(self) -> ProtocolError:
        """Return the finding if every state was refused."""
        if self.by_rule:
            return VersionMismatchError(
                f"g1: {self._ruled} states have the right length, but none has the right checksum (the "
                f"first: {self.first}): {self.remedy}"
            )
        length = self._lengths.most_common(1)[0][0]
        if length != LOW_STATE_BYTES:
            return WrongDeviceError(
                f"g1: the messages on {topics.LOW_STATE} have {length} bytes, but those of a G1 "
                f"{LOW_STATE_BYTES}: {self.remedy}"
            )
        return WrongDeviceError(f"g1: the messages on {topics.LOW_STATE} are no states of a G1: {self.first}")
