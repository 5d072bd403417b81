"""Counts refused states, with the reason and the remedy."""

from __future__ import annotations

import abc
from collections import Counter
from typing import ClassVar

from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.errors import FrameError, ProtocolError, VersionMismatchError, WrongDeviceError


class StateRefusals(abc.ABC):
    """Counts refused states.

    Attributes:
        count: Number of refused states.
        first: Reason of the first refusal, as text; "" before.
        robot: The robot's name in messages, and as its maker writes it.
        state_bytes: Length of its LowState.
        rule: What a state of the right length has, beside its values.
    """

    robot: ClassVar[tuple[str, str]]
    state_bytes: ClassVar[int]
    rule: ClassVar[str]

    def __init__(self) -> None:
        self.count, self.first = 0, ""
        self._ruled = 0
        self._lengths: Counter[int] = Counter()

    def add(self, payload: bytes, error: FrameError) -> None:
        """Take a refused message and the reason."""
        self.count += 1
        self.first = self.first or str(error)
        self._lengths[len(payload)] += 1
        self._ruled += len(payload) == self.state_bytes and payload[:4] == CDR_HEADER

    @property
    def by_rule(self) -> bool:
        """Whether most refused states have the robot's length and encoding: then :attr:`rule` differs."""
        return 2 * self._ruled > self.count

    @property
    @abc.abstractmethod
    def remedy(self) -> str:
        """Remedy if every state was refused."""

    @property
    @abc.abstractmethod
    def of_length(self) -> str:
        """Remedy if the states have another length."""

    @property
    def length(self) -> int:
        """The most frequent length of the refused states."""
        return self._lengths.most_common(1)[0][0]

    def error(self) -> ProtocolError:
        """Return the finding if every state was refused."""
        name, written = self.robot
        if self.by_rule:
            return VersionMismatchError(
                f"{name}: {self._ruled} states have the right length, but none has the right {self.rule} "
                f"(the first: {self.first}): {self.remedy}"
            )
        if self.length != self.state_bytes:
            return WrongDeviceError(
                f"{name}: the messages on {topics.LOW_STATE} have {self.length} bytes, but those of a "
                f"{written} {self.state_bytes}: {self.of_length}"
            )
        return WrongDeviceError(
            f"{name}: the messages on {topics.LOW_STATE} are no states of a {written}: {self.first}"
        )
