"""The passive command, repeated until the robot shows it or a stated time is over: the last thing of any run.

It works against a clock, not a count of attempts: a link that is gone as the run ends may come back, and a
robot that holds its last command would stay stiff for ever.
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
    """How hard to try."""

    timeout_s: float = 30.0
    """How long the command is repeated without a sign of the robot [s]: longer than a network takes to come
    back (Zenoh goes to its end point once a second; a switch that restarts takes some 20 s)."""
    confirm_s: float = 0.05
    """How long to wait for the robot to show each one, and at most to read what waited from before [s]."""
    confirmations: int = 3
    """Commands in a row that the robot must show. A stiff robot that carries nothing looks damped: one state
    that comes as the link returns, before any command has got through, is no proof (2 of 40 link cuts over
    DDS left a Go2 on the floor stiff)."""
    reopen_s: float = 0.5
    """Time between two tries to open a transport that is lost [s]."""
    silent_s: float = 3.0
    """Without a state for this long the transport is opened again, even where it reports no error [s]."""

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


def _nothing(text: str, silence_s: float) -> None:
    return


def make_passive(
    robot: Robot,
    clock: Clock,
    config: PassiveConfig | None = None,
    *,
    progress: Callable[[str, float], None] = _nothing,
    abandoned: Callable[[], bool] = lambda: False,
) -> bool:
    """Send the passive command until the robot reports that its motors no longer follow commands.

    A send that raises is one failed attempt; the transport is then opened again. Never raises: whoever calls
    it has something worse at hand.

    Args:
        robot: Connected, or at least with a transport that was open.
        clock: For the waiting.
        config: How hard to try.
        progress: Called after each attempt that failed, with what the operator should read, which changes
            once a second, and with the longest time until the next call [s].
        abandoned: Whether the operator gave up; asked after each attempt.

    Returns:
        Whether the robot confirmed it.
    """
    try_hard = _Endeavour(robot, clock, config or PassiveConfig(), progress)
    while not try_hard.attempt():
        if try_hard.over or abandoned():
            return False
        try_hard.prepare_next()
    return True


class _Endeavour:
    """The attempts at making one robot passive, and what is known of the link between them."""

    _next_ns: int
    _trouble: Exception | None

    def __init__(
        self, robot: Robot, clock: Clock, config: PassiveConfig, progress: Callable[[str, float], None]
    ) -> None:
        self._robot, self._clock, self._config, self._progress = robot, clock, config, progress
        self._shown = 0
        self._begin_ns = self._heard_ns = clock.now_ns()
        self._reopen_ns = self._begin_ns

    @property
    def over(self) -> bool:
        """Whether the time is over."""
        return self._clock.now_ns() - self._begin_ns >= round(self._config.timeout_s * 1e9)

    def attempt(self) -> bool:
        """Send the command once; return whether the robot has shown often enough that it is passive."""
        self._next_ns = self._until_ns()
        # Even a bug in a driver must not keep the next attempt from being made.
        try:
            # First of all the command: a path that cannot be read may still be written.
            self._robot.passive()
            confirmed = self._drained() and self._confirmed()
            self._trouble = None
        except Exception as error:
            confirmed, self._trouble = False, error
        self._shown = self._shown + 1 if confirmed else 0
        return self._shown >= self._config.confirmations

    def prepare_next(self) -> None:
        """Tell, open the transport again where it seems lost, and wait where the attempt took no time.

        After a command that the robot showed the next one follows at once.
        """
        if self._shown:
            return
        silent = self._clock.now_ns() - self._heard_ns >= round(self._config.silent_s * 1e9)
        if (self._trouble is not None or silent) and self._clock.now_ns() >= self._reopen_ns:
            # Opening may take seconds where something listens and does not answer.
            self._tell(silence_s=10.0)
            with contextlib.suppress(Exception):
                self._robot.reopen()
            pause_s = self._config.reopen_s if self._trouble is not None else self._config.silent_s
            self._reopen_ns = self._clock.now_ns() + round(pause_s * 1e9)
        self._tell(silence_s=1.0)
        self._clock.sleep_until_ns(self._next_ns)

    def _until_ns(self) -> int:
        """Return when the robot has had the time that it is given to show one command."""
        return self._clock.now_ns() + round(self._config.confirm_s * 1e9)

    def _tell(self, silence_s: float) -> None:
        passed_s = (self._clock.now_ns() - self._begin_ns) // 10**9
        left_s = max(round(self._config.timeout_s) - passed_s, 0)
        why = (
            f"the link is down ({self._trouble})"
            if self._trouble is not None
            else "the robot does not show it"
        )
        text = f"{why}; passive command repeated for {passed_s} s, {left_s} s left"
        self._progress(text, silence_s)

    def _drained(self) -> bool:
        """Forget the samples that waited; return whether the next one comes from after the command.

        A robot that sends faster than it is read must not keep the next command from being sent.
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
