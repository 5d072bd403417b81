"""Asks the robot's services to release the robot, and to take it back.

The robot's own controller (sport mode) sends commands to the same motors. Release it before you command
them. Functions, names and error texts: unitree_sdk2 @ 21d0a3b,
unitree_sdk2_python @ 37116c5.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final

from deal_hw.clock import Clock
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.rpc import Request, Response, decode_response, encode_request
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.errors import FrameError, ProtocolError, SafetyError, TransportTimeoutError
from deal_hw.transport import Message

SWITCHER, SPORT, ROBOT_STATE = topics.SERVICES
CHECK_MODE, SELECT_MODE, RELEASE_MODE = 1001, 1002, 1003
STAND_DOWN: Final = 1005
SERVICE_SWITCH: Final = 1001
OLD_SERVICE: Final = "sport_mode"
BUSY: Final = 7002
ERRORS: Final[Mapping[int, str]] = {
    3102: "the request could not be sent",
    3104: "no answer in time",
    3203: "the function is missing; the robot's firmware is older or newer than the versions that deal-hw "
    "supports",
    3204: "the parameter is wrong",
    4201: "sport mode took too long",
    4205: "sport mode is not ready yet; wait until the robot has booted",
    7001: "the parameter is wrong",
    7002: "the switcher is busy; wait until the robot's movement has ended and try again",
    7003: "the event is not valid",
    7004: "there is no mode of that name on this robot",
    7005: "an internal command failed; restart the robot",
    7006: "checking the mode failed; restart the robot",
    7007: "switching the mode failed; restart the robot",
    7008: "releasing the mode failed; {quiet} and try again",
    7009: "setting the configuration failed",
}
"""Meanings of response codes; ``{quiet}`` stands for the robot's own remedy."""

_ASK_S: Final = 0.5
"""Time between repeated requests: a first one may be lost during the network's discovery [s]."""
_PATIENCE_S: Final = 3.0
"""A switcher that is silent for this long does not exist, as in older firmware [s]."""
_UNREACHED_S: Final = 1.5
"""After three requests a bridge has reported whether they reach it: it does so five times a second [s]."""
_ACT_S: Final = 5.0
"""Longest wait for an answer, as in the vendor's SDK [s]."""


_UNHEARD: Final = (
    "states arrive, but requests do not reach the robot, or it has no such services, as in a simulator. A "
    "bridge must also carry rt/api/*/request and rt/api/*/response"
)


class RefusedError(SafetyError):
    """A service answered with an error.

    Attributes:
        code: The service's code.
    """

    def __init__(self, what: str, code: int, wording: Wording) -> None:
        self.code = code
        why = ERRORS.get(code, "an unknown error").format(quiet=wording.quiet)
        super().__init__(f"{wording.name}: {what} was refused: {why} (code {code})")


class ServiceClient:
    """Sends requests and waits for their responses.

    Args:
        send: Sends a payload on a topic.
        pump: Receives one message, waiting at most this long [s], and passes it to its reader; raises
            TransportTimeoutError if none arrives.
        clock: For waiting and for numbering.
        wording: What messages say of the robot.

    Attributes:
        wording: As given.
    """

    def __init__(
        self,
        send: Callable[[str, bytes], object],
        pump: Callable[[float], None],
        clock: Clock,
        wording: Wording,
    ) -> None:
        self._send, self._pump, self._clock, self.wording = send, pump, clock, wording
        self._identity = 0
        self._waiting = ""
        self._response: Response | None = None

    def take(self, message: Message) -> None:
        """Take a message of a response topic; answers to other programs are skipped."""
        if message.channel != self._waiting:
            return
        try:
            response = decode_response(message.payload)
        except FrameError:
            return
        if response.identity == self._identity:
            self._response = response

    def ask(self, service: str, api: int, parameter: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a request and return the answer's data.

        Raises:
            TransportTimeoutError: No answer in time.
            RefusedError: The answer is an error.
        """
        # Other programs use the clock as number, too, and on this computer it is the same clock.
        self._identity = max(self._identity + 1, self._clock.now_ns())
        self._waiting, self._response = topics.response(service), None
        self._send(
            topics.request(service), encode_request(Request(self._identity, api, json.dumps(dict(parameter))))
        )
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while (response := self._response) is None:
            left_ns = deadline_ns - self._clock.now_ns()
            if left_ns <= 0:
                raise TransportTimeoutError(
                    f"{self.wording.name}: service {service} did not answer request {api} within "
                    f"{timeout_s:g} s (code 3104)"
                )
            try:
                self._pump(left_ns * 1e-9)
            except TransportTimeoutError:
                continue
        if response.code != 0:
            raise RefusedError(f"request {api} to {service}", response.code, self.wording)
        return response.json()


class MotionSwitcher:
    """Releases the robot's own controller, and returns the robot to it.

    Attributes:
        released: Name of the mode that was released; "" for none.
        old: Whether the firmware is old, so that only the service list can switch the controller off.

    Args:
        services: The robot's services.
        clock: For waiting.
        why_unreached: Returns why requests since a time [ns] cannot reach the robot; "" if nothing is known.
    """

    def __init__(
        self,
        services: ServiceClient,
        clock: Clock,
        why_unreached: Callable[[int], str] = lambda since_ns: "",
    ) -> None:
        self.released = ""
        self.old = False
        self._services, self._clock, self._why_unreached = services, clock, why_unreached
        self._name = services.wording.name
        self._old_active = True
        self._answered = False

    def active(self, timeout_s: float) -> str:
        """Return the name of the active mode; "" for none.

        Raises:
            TransportTimeoutError: No answer in time.
            RefusedError: The answer is an error.
            ProtocolError: The answer names no mode.
        """
        if self.old:
            return OLD_SERVICE if self._old_active else ""
        patience_s = min(timeout_s, _PATIENCE_S)
        begin_ns = self._clock.now_ns()
        deadline_ns = begin_ns + round(patience_s * 1e9)
        while (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            try:
                answer = self._services.ask(SWITCHER, CHECK_MODE, {}, min(_ASK_S, left_ns * 1e-9))
            except TransportTimeoutError:
                self._check_reached(begin_ns)
                continue
            except RefusedError as error:
                if error.code != BUSY:
                    raise
                continue
            if not isinstance(name := answer.get("name"), str):
                raise ProtocolError(f"{self._name}: motion_switcher's answer {answer!r} names no mode")
            self._answered = True
            return name
        if self._answered or patience_s < _PATIENCE_S:
            raise TransportTimeoutError(
                f"{self._name}: motion_switcher did not answer within {patience_s:g} s (code 3104): "
                f"{_UNHEARD}"
            )
        self.old = True
        return OLD_SERVICE

    def _check_reached(self, begin_ns: int) -> None:
        """Check that nothing is known to keep requests from the robot, once that can be known."""
        if self._clock.now_ns() - begin_ns >= round(_UNREACHED_S * 1e9) and (
            why := self._why_unreached(begin_ns)
        ):
            raise TransportTimeoutError(f"{self._name}: {why}")

    def lie_down(self, timeout_s: float) -> None:
        """Ask the active mode to lay the robot down; a refusal or a missing answer is ignored."""
        try:
            self._services.ask(SPORT, STAND_DOWN, {}, min(timeout_s, _ACT_S))
        except (TransportTimeoutError, RefusedError):
            return

    def release(self, name: str, timeout_s: float) -> None:
        """Ask the active mode to release the robot; :meth:`active` returns the result.

        Raises:
            TransportTimeoutError: No answer in time.
            RefusedError: The answer is an error.
        """
        self.released = self.released or name
        timeout_s = min(timeout_s, _ACT_S)
        if not self.old:
            try:
                self._services.ask(SWITCHER, RELEASE_MODE, {}, timeout_s)
            except RefusedError as error:
                if error.code != BUSY:
                    raise
            return
        try:
            self._services.ask(ROBOT_STATE, SERVICE_SWITCH, {"name": OLD_SERVICE, "switch": 0}, timeout_s)
        except TransportTimeoutError as error:
            raise TransportTimeoutError(
                f"{self._name}: neither motion_switcher nor robot_state answers (code 3104): {_UNHEARD}"
            ) from error
        self._old_active = False

    def select(self, name: str, timeout_s: float) -> None:
        """Give the robot to a mode, which stands it up, and wait until it is active.

        Raises:
            TransportTimeoutError: It is not active in time.
            RefusedError: The answer is an error.
        """
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self.old:
            self._services.ask(ROBOT_STATE, SERVICE_SWITCH, {"name": name, "switch": 1}, timeout_s)
            self._old_active = True
        else:
            self._services.ask(SWITCHER, SELECT_MODE, {"name": name}, min(timeout_s, _ACT_S))
            while self.active(_PATIENCE_S) != name:
                if self._clock.now_ns() >= deadline_ns:
                    raise TransportTimeoutError(
                        f"{self._name}: mode {name!r} did not take the robot within {timeout_s:g} s; use "
                        "the remote"
                    )
        self.released = ""
