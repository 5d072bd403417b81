"""The emulated Go2's services: motion switcher, sport mode and robot state.

Names, numbers and answers: unitree_sdk2_python @ 37116c5 and unitree_sdk2 @ 21d0a3b (motion switcher, sport,
robot state, RPC errors). Other authors' programs for real robots select a mode while another one is active,
and wait for the robot to stand up. These facts are not published, and are assumed: a release takes 0.3 s and
waits for a present movement; meanwhile the switcher is busy; after it, the motors keep the last command.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

from deal_hw.drivers.go2.emulator.sport_controller import Posture, SportController
from deal_hw.drivers.unitree.emulated_quadruped import EmulatedQuadruped
from deal_hw.drivers.unitree.rpc import Request, Response, decode_request, encode_response
from deal_hw.errors import UnknownNameError
from deal_hw.types import FloatArray

SERVICE_OF: Final[Mapping[str, str]] = {
    "normal": "sport_mode",
    "ai": "ai_sport",
    "advanced": "advanced_sport",
    "mcf": "mcf",
}
"""Names of motion modes and of the processes behind them."""
RELEASE_MS: Final = 300
NO_SUCH_API: Final = 3203
BAD_PARAMETER: Final = 3204
SWITCHER_BUSY: Final = 7002
SWITCHER_NAME: Final = 7004
API_VERSION: Final = 1
_VERSION: Final = "1.0.0.1"
"""Text without quotes, as the SDK's own server sends it: its client compares it unchanged."""
_SWITCH_PROTECTED: Final = 5
_OTHER_SERVICES: Final = ("motion_switcher", "robot_state")


class SportMode:
    """State of sport mode: its name while active, and its controller.

    Attributes:
        name: Its name while active; "" once released.
        controller: Its stand controller.

    Args:
        machine: Its gains and motor mode.
        name: The mode at power-up; "" for none.
    """

    def __init__(self, machine: EmulatedQuadruped, name: str = "normal") -> None:
        if name and name not in SERVICE_OF:
            raise UnknownNameError("sport mode", name, SERVICE_OF)
        self.name, self._machine = name, machine
        self.controller = self._new_controller()
        self._release_ms: int | None = None

    @property
    def releasing(self) -> bool:
        """Whether a release is in progress."""
        return self._release_ms is not None

    def select(self, name: str, position: FloatArray, now_ms: int) -> None:
        """Take the robot over and stand it up, from measured positions (12,)."""
        self.name, self._release_ms = name, None
        self.controller = self._new_controller()
        self.controller.take(Posture.STANDING, position, now_ms)

    def release(self, now_ms: int) -> None:
        """Begin a release."""
        if self.name and self._release_ms is None:
            self._release_ms = now_ms + RELEASE_MS

    def update(self, now_ms: int) -> None:
        """Finish the release when it is time."""
        due = self._release_ms is not None and now_ms >= self._release_ms
        if due and self.controller.progress(now_ms) >= 1.0:
            self.name, self._release_ms = "", None

    def _new_controller(self) -> SportController:
        return SportController(self._machine.sport, self._machine.servo_modes[0])


class ServiceServer:
    """Answers requests.

    Attributes:
        answered: Number of answered requests.

    Args:
        sport: Sport mode.
    """

    def __init__(self, sport: SportMode) -> None:
        self.answered = 0
        self._sport = sport
        self._apis: Mapping[str, Mapping[int, Callable[[Any, FloatArray, int], tuple[int, Any]]]] = {
            "motion_switcher": {1001: self._check, 1002: self._select, 1003: self._release},
            "sport": {
                1001: self._go(Posture.DAMPING),
                1002: self._go(Posture.BALANCING),
                1003: self._stop_move,
                1004: self._go(Posture.STANDING),
                1005: self._go(Posture.DOWN),
                1006: self._go(Posture.RECOVERING),
                1008: self._move,
            },
            "robot_state": {1001: self._switch, 1003: self._list},
        }

    def answer(self, service: str, payload: bytes, position: FloatArray, now_ms: int) -> bytes | None:
        """Act on a request and return the response; None if none was requested, or the service is gone.

        Args:
            service: The service's name.
            payload: The request.
            position: Measured joint positions, (12,) [rad].
            now_ms: Device time [ms].

        Raises:
            FrameError: The payload is no request.
        """
        request = decode_request(payload)
        if service == "sport" and not self._sport.name:
            # The process that would answer is gone, so the caller's time-out passes.
            return None
        code, data = self._act(service, request, position, now_ms)
        self.answered += 1
        if request.no_reply:
            return None
        return encode_response(Response(request.identity, request.api, code, data))

    def _act(self, service: str, request: Request, position: FloatArray, now_ms: int) -> tuple[int, str]:
        if request.api == API_VERSION:
            return 0, _VERSION
        function = self._apis[service].get(request.api)
        if function is None:
            return NO_SUCH_API, ""
        try:
            code, data = function(json.loads(request.parameter or "{}"), position, now_ms)
        except (ValueError, KeyError, TypeError, RecursionError):
            return BAD_PARAMETER, ""
        return code, "" if data is None else json.dumps(data)

    # motion_switcher

    def _check(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        return 0, {"form": "0", "name": self._sport.name}

    def _select(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        name = str(asked["name"])
        aliases = {service: mode for mode, service in SERVICE_OF.items()}
        name = aliases.get(name, name)
        if name not in SERVICE_OF:
            return SWITCHER_NAME, None
        if self._sport.releasing:
            return SWITCHER_BUSY, None
        if self._sport.name != name:
            self._sport.select(name, position, now_ms)
        return 0, None

    def _release(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        self._sport.release(now_ms)
        return 0, None

    # sport

    def _go(self, posture: Posture) -> Callable[[Any, FloatArray, int], tuple[int, Any]]:
        def go(asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
            self._sport.controller.take(posture, position, now_ms)
            return 0, None

        return go

    def _move(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        velocity = float(asked["x"]), float(asked["y"]), float(asked["z"])
        if not all(math.isfinite(v) for v in velocity):
            return BAD_PARAMETER, None
        self._sport.controller.velocity = velocity
        return 0, None

    def _stop_move(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        self._sport.controller.velocity = (0.0, 0.0, 0.0)
        return 0, None

    # robot_state

    def _switch(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        service, on = str(asked["name"]), bool(int(asked["switch"]))
        modes = {name: mode for mode, name in SERVICE_OF.items()}
        if service in _OTHER_SERVICES:
            return 0, {"name": service, "status": _SWITCH_PROTECTED}
        if service not in modes:
            return BAD_PARAMETER, None
        mode = modes[service]
        if on and not self._sport.name:
            self._sport.select(mode, position, now_ms)
        elif not on and self._sport.name == mode:
            self._sport.release(now_ms)
        return 0, {"name": service, "status": 0 if on else 1}

    def _list(self, asked: Any, position: FloatArray, now_ms: int) -> tuple[int, Any]:
        active = SERVICE_OF.get(self._sport.name)
        # As in the vendor's stand example: 0 is active.
        return 0, [
            {
                "name": service,
                "status": 0 if service in (active, *_OTHER_SERVICES) else 1,
                "protect": int(service in _OTHER_SERVICES),
            }
            for service in (*SERVICE_OF.values(), *_OTHER_SERVICES)
        ]
