"""Selects the valid and new LowStates, and estimates when they were sensed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Generic, Protocol, TypeVar

from deal_hw.drivers.command_echo import ClockOffset
from deal_hw.errors import FrameError, ProtocolError, TransportLostError
from deal_hw.transport import Message

PERIOD_MS: Final = 2
RESTART_MS: Final = 1000
"""If the clock goes back further than this, it was restarted; if less, messages arrived out of order."""
_ONE_ROBOT: Final = 0.4
"""If a larger share of states is not new, two robots send them."""
_U32: Final = 1 << 32


class Frame(Protocol):
    """What the stream reads in a state."""

    @property
    def tick_ms(self) -> int:
        """The robot's clock, modulo 2**32 [ms]."""
        ...


class RefusedStates(Protocol):
    """Counts refused states, with the reason and the remedy."""

    count: int
    first: str

    def add(self, payload: bytes, error: FrameError) -> None:
        """Take a refused message and the reason."""
        ...

    @property
    def remedy(self) -> str:
        """Remedy if every state was refused."""
        ...

    def error(self) -> ProtocolError:
        """Return the finding if every state was refused."""
        ...


F = TypeVar("F", bound=Frame)


class TickStream(Generic[F]):
    """Checks each LowState by its bytes and its tick, and keeps the robot's time.

    Attributes:
        errors: Number of corrupt, missing, repeated and out-of-order states so far.
        accepted: Number of valid new states so far.
        stale: Number of states so far that were not newer than the one before.
        sequence: Number of the newest state, counted in periods of the robot's clock.
        device_ns: The robot's clock at the newest state, without its wraps [ns].

    Args:
        name: The robot, as messages begin.
        decode: Returns the state in a payload; raises a FrameError where it is corrupt.
        refusals: Makes what counts refused states.
    """

    def __init__(
        self, name: str, decode: Callable[[bytes], F], refusals: Callable[[], RefusedStates]
    ) -> None:
        self._name, self._decode, self._make_refusals = name, decode, refusals
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.errors = self.accepted = self.stale = self.device_ns = 0
        self._offset = ClockOffset()
        self.sequence = -1
        self._tick: int | None = None
        self._refused = self._make_refusals()

    def take(self, message: Message) -> F | None:
        """Return the state in a message; None where it is corrupt or not new.

        Raises:
            TransportLostError: The robot's clock was restarted.
        """
        try:
            frame = self._decode(message.payload)
        except FrameError as error:
            self.errors += 1
            self._refused.add(message.payload, error)
            return None
        tick = frame.tick_ms
        # Signed: a state that arrives out of order is a little older. Unsigned it would seem 2**32 ms newer.
        step = PERIOD_MS if self._tick is None else (tick - self._tick + _U32 // 2) % _U32 - _U32 // 2
        if step <= 0:
            self.errors += 1
            self.stale += 1
            if step < -RESTART_MS:
                before, self._tick = self._tick, None
                raise TransportLostError(
                    f"{self._name}: the robot's clock went back from {before} to {tick} ms: it was restarted "
                    "(connect again once it has booted), or a second robot is on the network"
                )
            return None
        if self._tick is not None:
            self.errors += max(step // PERIOD_MS - 1, 0)
        first = self.accepted == 0
        self.device_ns = tick * 1_000_000 if first else self.device_ns + step * 1_000_000
        self.sequence += max(step // PERIOD_MS, 1)
        self._tick = tick
        self.accepted += 1
        self._offset.take(message.stamp_ns, self.device_ns)
        return frame

    @property
    def offset_ns(self) -> int:
        """Host clock minus robot clock, by the fastest recent message [ns]."""
        return self._offset.offset_ns

    @property
    def doubled(self) -> bool:
        """Whether so many states are not new that two robots must be sending them."""
        return self.stale > _ONE_ROBOT * self.accepted

    @property
    def standstill(self) -> str:
        """Text on what does not change in states that are not new."""
        return f"their clock stands still at {self.device_ns // 1_000_000} ms"

    def complaint(self) -> ProtocolError | None:
        """Return the error if states arrive and none is valid; None if none arrived, or some are valid."""
        return None if self.accepted or not self._refused.count else self._refused.error()
