"""What robots on a bus of servos have in common: servos send only answers, so a robot requests its states."""

from __future__ import annotations

import abc
from collections import deque
from collections.abc import Mapping
from typing import Any, Final, Generic, TypeVar

from deal_hw.clock import Clock
from deal_hw.drivers.servo_bus.interface import ServoBus
from deal_hw.drivers.servo_bus.polling import Poller
from deal_hw.errors import ConfigurationError, TransportTimeoutError
from deal_hw.robot import Robot
from deal_hw.transport import Message, Transport
from deal_hw.types import RobotState, Status

BusT = TypeVar("BusT", bound=ServoBus)

_QUEUE: Final = 4096
MISSES: Final = 3
"""Samples in a row without an answer before servos are asked one by one, and before one counts as absent."""
COMMANDS: Final = 64
"""Most sent commands that are remembered until the servos show them."""


class PolledRobot(Robot, Generic[BusT]):
    """A robot that requests a state ``state_rate_hz`` times a second, timed as :class:`Poller` says.

    Args:
        transport: A byte stream at the bus' baud rate.
        clock: The clock of the transport's stamps.
        bus: The bus over it.
        state_rate_hz: States per second.
        supply: What to check if no state comes, for the message.
    """

    info: Any

    def __init__(
        self, transport: Transport, clock: Clock, bus: BusT, state_rate_hz: float, supply: str
    ) -> None:
        self.info = None
        self._transport, self._clock, self._bus, self._supply = transport, clock, bus, supply
        self._period_ns = round(1e9 / state_rate_hz)
        self._poller = Poller(clock, self._period_ns)

    def _forget(self) -> None:
        """Forget all about the servos, which may be others now."""
        self._poller.restart()
        self._states: deque[RobotState] = deque(maxlen=_QUEUE)
        self._sent: deque[Any] = deque(maxlen=COMMANDS)
        self._sequence = self._missed_command = -1
        self._alive_ns = 0
        self._asked: tuple[int, ...] = ()
        self._homed = self._homing = self._armed = self._anchored = self._watchdog = False
        self._fault = ""
        self._lost_commands, self._errors_before = 0, self._bus.errors

    def connect(self) -> None:
        """Open the transport, find the servos, and check their settings."""
        if self.info is not None:
            return
        if not self._transport.can_send:
            raise ConfigurationError(
                "servos answer only to requests, but a dry run sends nothing; leave --dry-run out"
            )
        self._transport.open()
        self._bus.watch.restart()
        try:
            info = self._examine()
            self._forget()
            self.info = info
        except BaseException:
            self._transport.close()
            raise

    @property
    def _where(self) -> str:
        return str(getattr(self._transport, "port", type(self._transport).__name__))

    @abc.abstractmethod
    def _examine(self) -> Any:
        """Return what the servos report about themselves, or raise why they cannot be used."""

    def disconnect(self) -> None:
        """Close the transport."""
        self._transport.close()
        self.info = None

    def reopen(self) -> None:
        """Open the port again where it vanished."""
        self._transport.reopen()
        self._expect_nothing()

    def read_state(self, timeout_s: float) -> RobotState:
        """Return the next state; request it if one is due and the answer fits the time.

        Args:
            timeout_s: Longest wait [s]; 0 takes received answers and requests nothing.
        """
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self._sent and not self._anchored and timeout_s > 0:
            # Once a command: with one state a command, an answer that is late costs a whole period.
            self._anchored = True
            self._anchor(deadline_ns)
        while not self._states:
            if self._expects:
                self._take(deadline_ns)
            elif self._poller.fits(deadline_ns):
                self._clock.sleep_until_ns(self._poller.next_ns)
                self._ask()
            else:
                self._clock.sleep_until_ns(deadline_ns)
            if not self._states and self._clock.now_ns() >= deadline_ns:
                why = self._fault or f"check {self._supply} ({self.transport_errors} errors)"
                raise TransportTimeoutError(
                    f"{self.description.name}: no state within {timeout_s:g} s; {why}"
                )
        return self._states.popleft()

    def _anchor(self, deadline_ns: int) -> None:
        """Move the requests so that one is answered just before a deadline [ns]."""
        self._poller.anchor(deadline_ns)

    def _ask(self) -> None:
        now_ns = self._clock.now_ns()
        if self._armed and self.watchdog_s and now_ns - self._alive_ns > round(self.watchdog_s * 1e9):
            # Our own requests keep the servos' watchdogs quiet. So this check stops the motors if a caller
            # only reads states.
            self.passive()
            self._watchdog = True
        self._asked = self._whom()
        self._poller.asked(now_ns, self._request(self._asked))

    @abc.abstractmethod
    def _whom(self) -> tuple[int, ...]:
        """Return the servos to ask next: all in some order, or one while an absent one is searched."""

    @abc.abstractmethod
    def _request(self, servos: tuple[int, ...]) -> int:
        """Send a request to servos; return the send time [ns]."""

    @property
    def _expects(self) -> bool:
        """Whether an answer is on its way."""
        return bool(self._asked)

    def _expect_nothing(self) -> None:
        """Forget the answer that is on its way."""
        self._asked = ()

    @abc.abstractmethod
    def _take(self, deadline_ns: int) -> None:
        """Wait for the answer that is on its way, until a deadline [ns] at most."""

    def _left_s(self, end_ns: int) -> float:
        return max(0, end_ns - self._clock.now_ns()) / 1e9

    def _latch(self, fault: str) -> None:
        self._fault = self._fault or fault

    def _disarm(self) -> None:
        """Discard the states received before and an answer that is on its way; the motors are not stopped."""
        self._states.clear()
        self._armed = False
        self._bus.watch.restart()
        if self._expects:
            self._expect_nothing()
            self._poller.withdraw()

    @property
    def fault(self) -> str:
        """Fault of a servo after which the host must not continue; "" for none. Latched until armed again."""
        return self._fault

    @property
    def last_sequence(self) -> int:
        """Number of the last command sent; -1 before the first."""
        return self._sequence

    @property
    def transport_errors(self) -> int:
        """Number of corrupt or missing answers, and of commands that the servos did not show."""
        return self._bus.errors - self._errors_before + self._lost_commands

    def fileno(self) -> int:
        """Return the descriptor of the transport."""
        return self._transport.fileno()

    def take_wire(self) -> list[Message]:
        """Return and forget the raw messages since the last call; if many, only the newest."""
        wire = list(self._bus.wire)
        self._bus.wire.clear()
        return wire


def two_servos(servo: int, part: str) -> str:
    """Return that the answers of one servo alone are corrupt, what this means, and what to do.

    Args:
        servo: Its id.
        part: Its joint or part.
    """
    return (
        f"two servos answer as id {servo} ({part}), or its plug is loose: its answers are corrupt, those of "
        "the others are not. Unplug the servo that was added, or check the plug; give each servo an id of "
        "its own, then start again"
    )


def status_of(flags: Mapping[Status, object]) -> Status:
    """Return the flags whose values are true, as one status."""
    status = Status.NONE
    for flag, is_set in flags.items():
        status |= flag if is_set else Status.NONE
    return status
