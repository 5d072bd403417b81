"""The servos' side of an emulated bus: what buses of all kinds of servos have in common."""

from __future__ import annotations

import abc
from collections import deque
from collections.abc import Callable, Iterable
from functools import reduce
from operator import and_
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from deal_hw.drivers.servo_bus.registers import Register

TWIN_TICKS: Final = 700
"""How far a second servo with one's id stands from it."""


class ListeningServo(Protocol):
    """What a bus needs to know of an emulated servo."""

    @property
    def baud_rate(self) -> int:
        """Its rate [bit/s]."""
        ...

    def awake(self, now_ns: int) -> bool:
        """Return whether it listens at a time [ns]: for a while after a restart it does not."""
        ...


ServoT = TypeVar("ServoT", bound=ListeningServo)


class ServosSide(abc.ABC, Generic[ServoT]):
    """The servos, what they hear, and their answers that wait for their time on the wire.

    Attributes:
        position: The register of the present position, whose answers may get lost.
        servos: The servos; may be changed.
        host_baud_rate: Rate of the host's port; a servo with another rate receives noise. None: the same.
        alive_ns: When the last request came [ns].
        sense: Called with an id and the time [ns] at which this servo of a group reads its registers, before
            it does so: a servo reads them when its turn to answer comes.

    Args:
        servos: The servos.
        changed: Called after registers were written.
        loses: Called for each read of the present position; returns whether the answer is lost.
    """

    position: ClassVar[Register]

    def __init__(self, servos: list[ServoT], changed: Callable[[], None], loses: Callable[[], bool]) -> None:
        self.servos = servos
        self.host_baud_rate: int | None = None
        self.alive_ns = 0
        self.sense: Callable[[int, int], None] = lambda servo, now_ns: None
        self._now_ns = 0
        self._changed, self._loses_answer = changed, loses
        self._replies: deque[tuple[int, bytes]] = deque()

    @property
    def now_ns(self) -> int:
        """Present time [ns], set by the owner."""
        return self._now_ns

    @now_ns.setter
    def now_ns(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self._advance()

    @property
    @abc.abstractmethod
    def errors(self) -> int:
        """Corrupt requests received so far."""

    @property
    def next_ns(self) -> int | None:
        """When the next answer is complete [ns]; None if no answer waits."""
        return self._replies[0][0] if self._replies else None

    def take_reply(self) -> bytes:
        """Return and forget the next answer."""
        return self._replies.popleft()[1]

    @abc.abstractmethod
    def receive(self, data: bytes) -> None:
        """Take bytes from the host and handle the requests that they complete."""

    @abc.abstractmethod
    def receive_foreign(self, packet: bytes, shown: bool) -> None:
        """Take a whole packet of another master.

        Args:
            packet: Its bytes.
            shown: Whether the host receives it, too.
        """

    def _advance(self) -> None:
        """Let what the servos do by themselves follow the time, where the owner does not."""

    def _hears(self, servo: ServoT) -> bool:
        return servo.awake(self._now_ns) and self.host_baud_rate in (None, servo.baud_rate)

    def _loses(self, address: int, size: int) -> bool:
        return address <= self.position.address < address + size and self._loses_answer()


def at_once(answers: Iterable[bytes]) -> bytes:
    """Return what the host receives of answers that are sent at the same time: on the open line a 0 wins."""
    return bytes(reduce(and_, column) for column in zip(*answers, strict=False))
