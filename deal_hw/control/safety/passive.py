"""Repeats the passive command, at the end of every run, until the robot confirms it or a time limit is over.

The limit is a time, not a number of attempts: a connection that is lost when the run ends may come back, and
a robot that holds its last command would stay stiff for ever.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from deal_hw.clock import Clock
from deal_hw.errors import ConfigurationError, TransportTimeoutError
from deal_hw.robot import Robot
from deal_hw.types import Status


@dataclass(frozen=True, slots=True, kw_only=True)
class PassiveConfig:
    """Settings of repeating the passive command."""

    timeout_s: float = 30.0
    """How long the command is repeated without an answer of the robot [s]. This must be longer than a network
    takes to come back: Zenoh tries its end point once a second, a restarting switch takes about 20 s."""
    confirm_s: float = 0.05
    """Longest wait for the robot's confirmation of a command, and longest time to read older samples [s]."""
    confirmations: int = 3
    """Number of successive commands that the robot must confirm. A stiff robot without load looks damped, so
    one state that arrives when the connection returns, before any command, is no proof: with one
    confirmation, 2 of 40 cuts over DDS left a Go2 on the floor stiff."""
    reopen_s: float = 0.5
    """Time between two attempts to open a lost transport [s]."""
    silent_s: float = 3.0
    """Without a state for this long, the transport is opened again even if it reports no error [s]."""

    def __post_init__(self) -> None:
        for field in ("timeout_s", "confirm_s", "reopen_s", "silent_s"):
            value = getattr(self, field)
            if not 0 < value < 3600:
                raise ConfigurationError(
                    f"PassiveConfig.{field} is {value!r} s; allowed: above 0, below 3600"
                )
        if not 1 <= self.confirmations <= 100:
            raise ConfigurationError(
                f"PassiveConfig.confirmations is {self.confirmations!r}; allowed: 1 to 100"
            )


Progress = Callable[[str, float], None]
"""Takes a text for the operator, and the longest time until the next call [s]."""


def nothing(text: str, silence_s: float) -> None:
    """Take no note."""


def make_passive(
    robot: Robot,
    clock: Clock,
    config: PassiveConfig | None = None,
    *,
    progress: Progress = nothing,
) -> bool:
    """Send the passive command until the robot reports that its motors no longer follow commands.

    A send that raises is one failed attempt; the transport is then opened again. Never raises, because its
    callers already handle a more serious problem.

    Args:
        robot: Connected, or at least with a transport that was open.
        clock: For the waiting.
        config: Settings.
        progress: Called after each failed attempt, with a text for the operator, which changes once a second,
        and with the longest time until the next call [s]. What it raises, such as for a closed terminal, is
        ignored.

    Returns:
        Whether the robot confirmed it.
    """
    try_hard = _Endeavour(robot, clock, config or PassiveConfig(), progress)
    while not try_hard.attempt():
        if try_hard.over:
            return False
        try_hard.prepare_next()
    return True


class _Endeavour:
    """The attempts at making one robot passive, and the state of the connection between them."""

    _next_ns: int
    _trouble: Exception | None

    def __init__(self, robot: Robot, clock: Clock, config: PassiveConfig, progress: Progress) -> None:
        self._robot, self._clock, self._config, self._progress = robot, clock, config, progress
        self._shown = 0
        self._begin_ns = self._heard_ns = clock.now_ns()
        self._reopen_ns = self._begin_ns

    @property
    def over(self) -> bool:
        """Whether the time is over."""
        return self._clock.now_ns() - self._begin_ns >= round(self._config.timeout_s * 1e9)

    def attempt(self) -> bool:
        """Send the command once; return whether the robot has confirmed often enough that it is passive."""
        self._next_ns = self._until_ns()
        # Even a bug in a driver must not prevent the next attempt.
        try:
            # The command comes first, since a connection that cannot be read may still be written.
            self._robot.passive()
            confirmed = self._drained() and self._confirmed()
            self._trouble = None
        except Exception as error:
            confirmed, self._trouble = False, error
        self._shown = self._shown + 1 if confirmed else 0
        return self._shown >= self._config.confirmations

    def prepare_next(self) -> None:
        """Report, open the transport again if it seems lost, and wait if the attempt took no time.

        After a confirmed command the next one follows at once.
        """
        if self._shown:
            return
        silent = self._clock.now_ns() - self._heard_ns >= round(self._config.silent_s * 1e9)
        if (self._trouble is not None or silent) and self._clock.now_ns() >= self._reopen_ns:
            # Opening may take seconds if the other side listens but does not answer.
            self._tell(silence_s=10.0)
            with contextlib.suppress(Exception):
                self._robot.reopen()
            pause_s = self._config.reopen_s if self._trouble is not None else self._config.silent_s
            self._reopen_ns = self._clock.now_ns() + round(pause_s * 1e9)
        self._tell(silence_s=1.0)
        self._clock.sleep_until_ns(self._next_ns)

    def _until_ns(self) -> int:
        """Return the end of the robot's time to confirm one command."""
        return self._clock.now_ns() + round(self._config.confirm_s * 1e9)

    def _tell(self, silence_s: float) -> None:
        passed_s = (self._clock.now_ns() - self._begin_ns) // 10**9
        left_s = max(round(self._config.timeout_s) - passed_s, 0)
        why = (
            f"the connection is lost ({self._trouble})"
            if self._trouble is not None
            else "the robot does not confirm it"
        )
        text = f"{why}; passive command repeated for {passed_s} s, {left_s} s left"
        with contextlib.suppress(Exception):
            self._progress(text, silence_s)

    def _drained(self) -> bool:
        """Drop the waiting samples; return whether the next one is newer than the command.

        A robot that sends faster than it is read must not block the next command.
        """
        until_ns = self._until_ns()
        while self._clock.now_ns() < until_ns:
            try:
                self._robot.read_state(0.0)
            except TransportTimeoutError:
                return True
            self._heard_ns = self._clock.now_ns()
        return False

    def _confirmed(self) -> bool:
        until_ns = self._until_ns()
        while (left_ns := until_ns - self._clock.now_ns()) > 0:
            try:
                state = self._robot.read_state(left_ns * 1e-9)
            except TransportTimeoutError:
                return False
            self._heard_ns = self._clock.now_ns()
            if Status.ARMED not in state.status:
                return True
        return False
