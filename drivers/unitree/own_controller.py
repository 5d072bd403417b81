"""An emulated humanoid's own controller and its motion switcher.

Names, numbers and answers of the motion switcher: unitree_sdk2_python @ 37116c5. These facts are not
published, and are assumed: at power-up the mode "ai" has the robot and holds the joints at 0; its commands
are seen on ``rt/lowcmd``; a release takes 0.3 s; after it the joints are damped, as in the debug mode (L2 and
R2 of the remote).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, Final, Generic, TypeVar

import numpy as np

from deal_hw.drivers.transports.topics import SERVICES
from deal_hw.drivers.unitree.motor_command import MotorCommand
from deal_hw.drivers.unitree.rpc import Request, Response, decode_request, encode_response
from deal_hw.types import FloatArray

MODES: Final = ("ai", "normal", "advanced")
PERIOD_MS: Final = 2
RELEASE_MS: Final = 300
RISE_MS: Final = 2000
NO_SUCH_API: Final = 3203
BAD_PARAMETER: Final = 3204
SWITCHER_BUSY: Final = 7002
SWITCHER_NAME: Final = 7004
API_VERSION: Final = 1
_VERSION: Final = "1.0.0.1"
_STIFFNESS_NM_RAD: Final = 40.0
_DAMPING_NMS_RAD: Final = 2.0
DEBUG_DAMPING_NMS_RAD: Final = 3.0
SWITCHER: Final = SERVICES[0]

CommandT = TypeVar("CommandT", bound=MotorCommand)


class OwnController(Generic[CommandT]):
    """The robot's own controller, which holds its joints at 0, and the switcher that releases it.

    Attributes:
        name: Its mode while active; "" once released.
        answered: Number of answered requests.

    Args:
        joints: Number of joints.
        name: The mode at power-up; "" for none.
        make: Returns the command that holds positions, (J,), with a kp and a kd for all joints.
    """

    def __init__(self, joints: int, name: str, make: Callable[[FloatArray, float, float], CommandT]) -> None:
        self.name, self.answered = name, 0
        self._joints, self._make = joints, make
        self._from, self._begin_ms = np.zeros(joints), -RISE_MS
        self._release_ms: int | None = None

    def select(self, name: str, position: FloatArray, now_ms: int) -> None:
        """Take the robot over, from measured positions (J,)."""
        self.name, self._release_ms = name, None
        self._from, self._begin_ms = position.copy(), now_ms

    def update(self, now_ms: int) -> bool:
        """Finish a release when it is time; return whether that is now."""
        if self._release_ms is None or now_ms < self._release_ms:
            return False
        self.name, self._release_ms = "", None
        return True

    def command(self, now_ms: int) -> CommandT:
        """Return its present command."""
        share = min(1.0, (now_ms - self._begin_ms) / RISE_MS)
        return self._make((1.0 - share) * self._from, _STIFFNESS_NM_RAD, _DAMPING_NMS_RAD)

    def damped(self) -> CommandT:
        """Return the command of the debug mode: damped joints."""
        return self._make(np.zeros(self._joints), 0.0, DEBUG_DAMPING_NMS_RAD)

    def answer(self, service: str, payload: bytes, position: FloatArray, now_ms: int) -> bytes | None:
        """Act on a request and return the response; None if none was requested.

        Args:
            service: The service's name.
            payload: The request.
            position: Measured joint positions, (J,) [rad].
            now_ms: Device time [ms].

        Raises:
            FrameError: The payload is no request.
        """
        request = decode_request(payload)
        if request.api == API_VERSION:
            code, data = 0, _VERSION
        elif service != SWITCHER:
            code, data = NO_SUCH_API, ""
        else:
            code, data = self._switch(request, position, now_ms)
        self.answered += 1
        return (
            None if request.no_reply else encode_response(Response(request.identity, request.api, code, data))
        )

    def _switch(self, request: Request, position: FloatArray, now_ms: int) -> tuple[int, str]:
        if request.api == 1001:
            return 0, json.dumps({"form": "0", "name": self.name})
        if request.api == 1003:
            if self.name and self._release_ms is None:
                self._release_ms = now_ms + RELEASE_MS
            return 0, ""
        if request.api != 1002:
            return NO_SUCH_API, ""
        try:
            asked: Any = json.loads(request.parameter or "{}")
            name = str(asked["name"])
        except (ValueError, KeyError, TypeError, RecursionError):
            return BAD_PARAMETER, ""
        if name not in MODES:
            return SWITCHER_NAME, ""
        if self._release_ms is not None:
            return SWITCHER_BUSY, ""
        if self.name != name:
            self.select(name, position, now_ms)
        return 0, ""
