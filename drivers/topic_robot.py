"""A robot on topics: what its drivers have in common, whatever the messages."""

from __future__ import annotations

import abc
import contextlib
from collections import deque
from typing import Any, ClassVar, Final, Generic, Protocol, TypeVar

from deal_hw.clock import Clock
from deal_hw.errors import SafetyError, TransportError, TransportTimeoutError
from deal_hw.robot import Robot
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import RobotState

_QUEUE: Final = 4096
_BEFORE_S: Final = 0.05
"""What waited in buffers has been read after this time [s]."""
_ENOUGH: Final = 3
"""Number of new states after the first command that confirm the connection."""


class StateCounts(Protocol):
    """What a stream of states counts."""

    accepted: int
    """Valid and new states."""
    stale: int
    """States that were no newer than the one before."""
    errors: int
    """Corrupt, missing and repeated states."""


StreamT = TypeVar("StreamT", bound=StateCounts)


class TopicRobot(Robot, Generic[StreamT]):
    """A robot whose states and commands are messages on topics; all waits keep reading messages.

    Attributes:
        info: What the robot reported about itself; None before ``connect``.
        look_at: What to check if no state arrives.

    Args:
        transport: Topics of the robot.
        clock: The clock of the transport's stamps.
        name: The robot's name in messages.
        stream: Selects the valid and new states.
    """

    info: Any | None
    look_at: ClassVar[str]

    def __init__(self, transport: TopicTransport, clock: Clock, name: str, stream: StreamT) -> None:
        self._transport, self._clock, self._name = transport, clock, name
        self._stream = stream
        self._states: deque[RobotState] = deque(maxlen=_QUEUE)
        self._wire: deque[Message] = deque(maxlen=_QUEUE)

    @abc.abstractmethod
    def _forget(self) -> None:
        """Reset; an open transport can still make the robot passive."""

    @abc.abstractmethod
    def _pump(self, timeout_s: float) -> None:
        """Take one message, waiting for it.

        Raises:
            TransportTimeoutError: None arrives in time.
        """

    @property
    @abc.abstractmethod
    def _frozen(self) -> str:
        """What to say of states that repeat old ones."""

    def disconnect(self) -> None:
        """Close the transport."""
        self._transport.close()
        self._forget()

    def reopen(self) -> None:
        """Open the transport again where it is lost."""
        self._transport.reopen()

    def other_commander(self, listen_s: float) -> str:
        """Listen for commands of other programs; return who sends them, "" if nobody does.

        What a dead run sent may still wait in buffers, so it is read before the time begins.
        """
        for _ in range(2):
            with contextlib.suppress(TransportError):
                self._listen(_BEFORE_S)
                begin_ns = self._clock.now_ns()
                self._listen(listen_s)
                return self._commanded_since(begin_ns)
            # The connection was lost, as while this program was stopped.
            with contextlib.suppress(TransportError):
                self._transport.reopen()
        # Without a connection nobody is received.
        return ""

    def _listen(self, seconds: float) -> None:
        end_ns = self._clock.now_ns() + round(seconds * 1e9)
        while (left_ns := end_ns - self._clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)

    @abc.abstractmethod
    def _commanded_since(self, since_ns: int) -> str:
        """Return which other programs have commanded since a time [ns], as a sentence; "" for none."""

    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next valid and new state; others are counted and dropped."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        stale = self._stream.stale
        while not self._states:
            try:
                self._pump(max(0, deadline_ns - self._clock.now_ns()) * 1e-9)
            except TransportTimeoutError as error:
                frozen = f" ({self._frozen})" * (self._stream.stale > stale)
                raise TransportTimeoutError(
                    f"{self._name}: no new state within {timeout_s:g} s{frozen}; {self.look_at} "
                    f"({self.transport_errors} transport errors so far)"
                ) from error
        return self._states.popleft()

    @property
    def transport_errors(self) -> int:
        """Corrupt, incomplete, missing, repeated and overtaken states so far."""
        return self._stream.errors

    def fileno(self) -> int:
        """Return -1: each process opens its own path to the topics."""
        return -1

    def take_wire(self) -> list[Message]:
        """Return and forget the messages since the last call; repeats of a command are left out."""
        wire = list(self._wire)
        self._wire.clear()
        return wire

    def _await_new_states(self, timeout_s: float) -> None:
        """Wait for the states that follow a first command.

        Raises:
            TransportTimeoutError: They do not arrive in time.
        """
        seen = self._stream.accepted
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while self._stream.accepted < seen + _ENOUGH:
            if (left_ns := deadline_ns - self._clock.now_ns()) <= 0:
                raise TransportTimeoutError(
                    f"{self._name}: no new states within {timeout_s:g} s of the first command"
                )
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)

    def _drain(self) -> None:
        with contextlib.suppress(TransportTimeoutError):
            while True:
                self._pump(0.0)

    def _check_connected(self) -> None:
        if self.info is None:
            raise SafetyError(f"{self._name}: not connected; call connect() first")
