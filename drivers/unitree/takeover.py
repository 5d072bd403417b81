"""Takes the motors over: the robot's own controller releases them, and no other program commands them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Final

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.motion_switcher import MotionSwitcher, ServiceClient
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import SafetyError, TransportTimeoutError
from deal_hw.transport import Message, TopicTransport
from deal_hw.types import FloatArray

LISTEN_S: Final = 0.5
"""Before arming, no other program may have commanded the motors for this long [s]."""
RELEASE_PAUSE_S: Final = 1.0
"""Wait between releasing a mode and checking again, as in the vendor's example [s]."""
LIE_DOWN_S: Final = 4.0
"""Longest wait for a robot to come to rest after a request to lie down, by its own clock [s]: a simulator on
a busy computer is slower than real time."""
STILL_S: Final = 0.5
_STILL_RAD_S: Final = 0.3
_LYING_RAD: Final = 0.5
"""A robot whose joints are this close to its rest pose counts as lying."""


class Takeover:
    """Releases sport mode, returns the robot to it, and listens for other programs that command the motors.

    Args:
        transport: Topics of the robot.
        clock: For waiting.
        send: Sends a payload on a topic.
        pump: Receives one message, waiting at most this long [s], and passes it to its reader; raises
            TransportTimeoutError if none arrives.
        motion: Returns positions and velocities of the joints in the newest state, (J,) each.
        robot_ns: Returns the time of the newest state, by the robot's own clock [ns].
        rest: The pose of a lying robot, (J,) [rad]; None for one whose base is held, which cannot fall.
        wording: What messages say of the robot.
        services: Whether it has services, and with them a controller of its own to release.
        why_unreached: As of :class:`~deal_hw.drivers.unitree.motion_switcher.MotionSwitcher`.
    """

    def __init__(
        self,
        transport: TopicTransport,
        clock: Clock,
        send: Callable[[str, bytes], object],
        pump: Callable[[float], None],
        motion: Callable[[], tuple[FloatArray, FloatArray]],
        robot_ns: Callable[[], int],
        rest: FloatArray | None,
        wording: Wording,
        *,
        services: bool = True,
        why_unreached: Callable[[int], str] = lambda since_ns: "",
    ) -> None:
        self._transport, self._clock, self._pump = transport, clock, pump
        self._motion, self._robot_ns, self._rest = motion, robot_ns, rest
        self._wording = wording
        self._services = ServiceClient(send, pump, clock, wording)
        self._switcher = MotionSwitcher(self._services, clock, why_unreached)
        self._has_services = services
        self._foreign, self._foreign_ns = 0, -1

    def take(self, message: Message) -> None:
        """Take a message that is no state: another program's command, or a service's answer."""
        if message.channel == topics.LOW_COMMAND:
            self._foreign += 1
            self._foreign_ns = message.stamp_ns
        else:
            self._services.take(message)

    def run(self, timeout_s: float) -> None:
        """Lay the robot down, release its active mode, and wait until no other program commands the motors.

        Raises:
            TransportTimeoutError: The robot's services do not answer, or do not release it in time.
            SafetyError: The robot does not lie down, a service refuses, or another program commands the
                motors; the text names it.
        """
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while name := self._active(deadline_ns):
            self._lie_down(name, deadline_ns)
            self._switcher.release(name, self._left_s(deadline_ns))
            self._pump_until(self._clock.now_ns() + round(RELEASE_PAUSE_S * 1e9))
            if self._left_s(deadline_ns) <= 0:
                raise TransportTimeoutError(
                    f"{self._wording.name}: mode {name!r} did not release the robot within {timeout_s:g} s; "
                    f"{self._wording.free}, and try again"
                )
        self._await_silence(deadline_ns)

    def require_free(self, timeout_s: float) -> None:
        """Check that neither the robot's own controller nor another program commands the motors.

        Services that do not answer are no proof of a controller: an active one sends commands, which are
        received.

        Raises:
            SafetyError: One of them does; the text names it.
        """
        name = ""
        with contextlib.suppress(TransportTimeoutError):
            name = self._active(self._clock.now_ns() + round(timeout_s * 1e9))
        if name:
            raise SafetyError(
                f"{self._wording.name}: the robot's own controller {name!r} has it, and a second commander "
                f"would make it jump, so nothing was sent; {self._wording.quiet}"
            )
        self._await_silence(self._clock.now_ns())

    def hand_back(self, timeout_s: float) -> None:
        """Return the robot to the released mode; do nothing if none was released.

        Raises:
            TransportTimeoutError: The mode does not have the robot in time.
            SafetyError: The service refuses.
        """
        if self._switcher.released:
            self._switcher.select(self._switcher.released, timeout_s)

    @property
    def foreign(self) -> int:
        """Number of other programs' commands received so far."""
        return self._foreign

    @property
    def contested(self) -> bool:
        """Whether another program commanded the motors within the last :data:`LISTEN_S`."""
        return self._foreign > 0 and self._clock.now_ns() - self._foreign_ns < round(LISTEN_S * 1e9)

    def commanded_since(self, since_ns: int) -> str:
        """Return the text that another program has commanded since a time [ns]; "" if none has."""
        return self.complaint() if self._foreign_ns >= since_ns else ""

    def complaint(self) -> str:
        """Return the text that another program commands the motors, and which one it may be."""
        writers = self._transport.writers(topics.LOW_COMMAND)
        who = f" It is one of: {'; '.join(writers)}." if writers else ""
        return (
            f"{self._wording.name}: another program commands the robot's motors on {topics.LOW_COMMAND}."
            f"{who} Stop it; {self._wording.off}"
        )

    def _active(self, deadline_ns: int) -> str:
        return self._switcher.active(self._left_s(deadline_ns)) if self._has_services else ""

    def _lie_down(self, name: str, deadline_ns: int) -> None:
        """Lay the robot down if it does not lie: a robot released while it stands falls."""
        if self._lies():
            return
        self._switcher.lie_down(self._left_s(deadline_ns))
        self._await_stillness(deadline_ns)
        if not self._lies():
            raise SafetyError(
                f"{self._wording.name}: mode {name!r} did not lay the robot down, and a robot that is "
                "released while it stands falls; lay it down by its remote and try again"
            )

    def _lies(self) -> bool:
        return self._rest is None or bool(np.abs(self._motion()[0] - self._rest).max() < _LYING_RAD)

    def _await_stillness(self, deadline_ns: int) -> None:
        """Wait until the robot lies and its joints have stopped, up to a limit."""
        still_since_ns = self._robot_ns()
        until_ns = still_since_ns + round(LIE_DOWN_S * 1e9)
        while self._robot_ns() < until_ns and (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            with contextlib.suppress(TransportTimeoutError):
                self._pump(left_ns * 1e-9)
            if np.abs(self._motion()[1]).max() > _STILL_RAD_S:
                still_since_ns = self._robot_ns()
            elif self._robot_ns() - still_since_ns >= round(STILL_S * 1e9) and self._lies():
                return

    def _await_silence(self, deadline_ns: int) -> None:
        """Listen for commands; silent writers do not count, because the robot has some of its own."""
        listen_ns = round(LISTEN_S * 1e9)
        begin_ns = self._clock.now_ns()
        until_ns = max(deadline_ns, begin_ns + listen_ns)
        while (now_ns := self._clock.now_ns()) < until_ns:
            quiet_ns = max(begin_ns, self._foreign_ns)
            if now_ns - quiet_ns >= listen_ns:
                return
            with contextlib.suppress(TransportTimeoutError):
                self._pump((min(quiet_ns + listen_ns, until_ns) - now_ns) * 1e-9)
        if self._foreign_ns >= until_ns - listen_ns:
            raise SafetyError(self.complaint())

    def _pump_until(self, deadline_ns: int) -> None:
        while (now_ns := self._clock.now_ns()) < deadline_ns:
            with contextlib.suppress(TransportTimeoutError):
                self._pump((deadline_ns - now_ns) * 1e-9)

    def _left_s(self, deadline_ns: int) -> float:
        return max(deadline_ns - self._clock.now_ns(), 0) * 1e-9
