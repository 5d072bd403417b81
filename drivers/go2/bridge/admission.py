"""Who may command the robot through the bridge, and when the bridge damps it. It does no I/O.

    IDLE ----a controller's damping----> CONTROLLED ----silence----> DAMPING ----a controller's damping--> ...
     │ ▲                                     │                        ▲ │
     │ └--- handed back to sport mode -------┴--- or another program  │ │
     │                                           commands it ---------┼-┘
     └--- nobody commands it and no mode is active -------------------┘

A controller takes the robot over by a damping command, which no walking controller sends. The robot then
belongs to its stream until it is silent for longer than the limit. A controller that lost the robot during a
walk must take it over again in the same way.
"""

from __future__ import annotations

import enum
import json
from collections import Counter, OrderedDict
from typing import Any, Final

from deal_hw.drivers.go2.bridge.config import BridgeConfig
from deal_hw.drivers.go2.bridge.limits import CommandLimits, is_damping
from deal_hw.drivers.go2.bridge.robot_side import RobotSide
from deal_hw.drivers.go2.messages.low_command import LowCommand, decode_low_command
from deal_hw.drivers.transports import topics
from deal_hw.drivers.transports.zenoh_stamps import Echo, read_echo
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.motion_switcher import ROBOT_STATE, SELECT_MODE, SERVICE_SWITCH, SWITCHER
from deal_hw.drivers.unitree.rpc import Request, decode_request
from deal_hw.errors import FrameError, SafetyError
from deal_hw.transport import Message

_STREAMS: Final = 64
"""Number of streams whose newest sequences are remembered; messages of older streams are too old anyway."""
_TOLD: Final = 8
"""Number of streams that the status names, those received last."""
_REQUESTS: Final = {topics.request(name): name for name in topics.SERVICES}


class Control(enum.Enum):
    """Who controls the robot."""

    IDLE = "idle"
    """Neither a controller nor the bridge, which sends nothing."""
    CONTROLLED = "controlled"
    """A controller, through the bridge."""
    DAMPING = "damping"
    """The bridge, which damps it."""


class RefusedMessageError(SafetyError):
    """A message that is refused.

    Attributes:
        kind: One word for counting.
    """

    def __init__(self, kind: str, text: str) -> None:
        self.kind = kind
        super().__init__(text)


class Admission:
    """Judges the messages from the network.

    Attributes:
        control: Who controls the robot.
        reason: The reason, as text.
        admitted: Number of admitted commands.
        refused: Number of refused messages, by kind.
        last_refusal: Reason of the last refusal.
        robot_side: What is known of the robot's own side.

    Args:
        config: Settings.
        limits: Limits of a command.
        session: The number in the bridge's own stamps.
    """

    def __init__(self, config: BridgeConfig, limits: CommandLimits, session: int) -> None:
        self._config, self._limits, self._session = config, limits, session
        self._age_ns = round(config.command_age_s * 1e9)
        self._silence_ns = self._age_ns - round(config.margin_s * 1e9)
        self._release_ns = round(config.release_s * 1e9)
        self.control, self.reason = Control.IDLE, "nobody controls the robot yet"
        self.robot_side = RobotSide()
        self.admitted = 0
        self.refused: Counter[str] = Counter()
        self.last_refusal = self._refusal = ""  # The last of all, and the last since an admitted command.
        self._holder: int | None = None
        self._stiff = False
        self._last_ns = 0
        self._newest: OrderedDict[tuple[int, str], int] = OrderedDict()
        self._heard: OrderedDict[int, None] = OrderedDict()

    def command(self, message: Message, now_ns: int, frame: LowStateFrame | None) -> LowCommand | None:
        """Return the command in a message if it may go to the robot, else None.

        Args:
            message: Of ``rt/lowcmd``, with its attachment.
            now_ns: The bridge's clock [ns].
            frame: The robot's newest state; None before the first.
        """
        try:
            echo = self._link(message, now_ns)
            command = self._decode(message.payload)
            if text := self._limits.complaint(command, frame):
                raise RefusedMessageError("limits", f"beyond the robot's limits: {text}")
            self._hand_over(echo, is_damping(command))
        except RefusedMessageError as refusal:
            self._count(refusal)
            return None
        self._note(echo, message.channel)
        self._stiff, self._last_ns, self._refusal = not is_damping(command), now_ns, ""
        self.admitted += 1
        return command

    def request(self, message: Message, now_ns: int) -> bool:
        """Return whether a request to the services may pass; one for sport mode ends control."""
        try:
            echo = self._link(message, now_ns)
            self._check_holder(echo)
            if self._gives_back(message):
                if self._stiff and self.control is Control.CONTROLLED:
                    raise RefusedMessageError(
                        "handover",
                        "the robot cannot return to its own controller while it is commanded: damp it first",
                    )
                if self.control is not Control.IDLE:
                    # Until its own controller has it, the robot holds the damping of its last commander.
                    self.robot_side.left(now_ns, mode="", handed=True)
                self._become(Control.IDLE, "the robot was handed back to its own controller")
        except RefusedMessageError as refusal:
            self._count(refusal)
            return False
        self._note(echo, message.channel)
        return True

    def take_charge(self, reason: str) -> None:
        """Damp the robot until a controller takes it over."""
        self._become(Control.DAMPING, reason)

    def yield_to_robot_side(self, now_ns: int) -> None:
        """Stop damping: another program on the robot's side commands it, and two commanders make it jump."""
        if self.control is Control.DAMPING:
            # While the bridge damped, no mode was active.
            self.robot_side.left(now_ns, mode="")
            self._become(Control.IDLE, "another program on the robot's side commands the motors")
        self.robot_side.commanded(now_ns)

    def tick(self, now_ns: int) -> bool:
        """Check for silence; return whether a damping command must be sent now."""
        if self.control is Control.IDLE and (why := self.robot_side.deserted(now_ns)):
            self._become(Control.DAMPING, why)
        if self.control is not Control.CONTROLLED:
            return self.control is Control.DAMPING
        silent_ns = now_ns - self._last_ns
        if silent_ns <= self._silence_ns:
            return False
        if self._stiff:
            self._become(
                Control.DAMPING,
                f"no admissible command for {silent_ns / 1e6:.0f} ms, the limit is {self._age_ns / 1e6:g} ms"
                + (f"; the last refusal: {self._refusal}" if self._refusal else ""),
            )
        elif silent_ns > self._release_ns:
            self._become(Control.DAMPING, "the controller went passive and left")
        return True

    def status(self) -> dict[str, Any]:
        """Return who controls the robot and why, as plain values."""
        return {
            "control": self.control.value,
            "reason": self.reason,
            "stream": "" if self._holder is None else f"{self._holder:016x}",
            "admitted": self.admitted,
            "refused": dict(self.refused),
            "last_refusal": self.last_refusal,
            "heard": " ".join(f"{stream:016x}" for stream in self._heard),
        }

    def _become(self, control: Control, reason: str) -> None:
        self.control, self.reason = control, reason
        self._holder, self._stiff = None, False

    def _count(self, refusal: RefusedMessageError) -> None:
        self.refused[refusal.kind] += 1
        self.last_refusal = str(refusal)
        if refusal.kind != "holder":
            # A refusal of another controller does not explain the silence of this one.
            self._refusal = self.last_refusal

    def _link(self, message: Message, now_ns: int) -> Echo:
        """Return the sender's stream and number if the message is new and not too old."""
        try:
            echo = read_echo(message.attachment)
        except FrameError as error:
            raise RefusedMessageError("unstamped", str(error)) from error
        # Before any other check: a sender must know whether its messages get here at all.
        self._heard[echo.stream] = None
        self._heard.move_to_end(echo.stream)
        if len(self._heard) > _TOLD:
            self._heard.popitem(last=False)
        if echo.received.session != self._session:
            raise RefusedMessageError(
                "session",
                "its sender has received no state of this bridge yet"
                if not echo.received.session
                else "it answers states of another bridge, or of this one before its restart",
            )
        age_ns = now_ns - echo.received.time_ns
        if not 0 <= age_ns <= self._age_ns:
            raise RefusedMessageError(
                "age",
                f"its sender's newest state was {age_ns / 1e6:.1f} ms old when it came, at most "
                f"{self._age_ns / 1e6:g} ms are allowed: the network is slow, or the message is a replay",
            )
        newest = self._newest.get((echo.stream, message.channel), -1)
        if echo.sequence <= newest:
            raise RefusedMessageError(
                "sequence",
                f"number {echo.sequence} came after number {newest}: a replay, or overtaken on the way",
            )
        return echo

    def _note(self, echo: Echo, channel: str) -> None:
        self._newest[echo.stream, channel] = echo.sequence
        self._newest.move_to_end((echo.stream, channel))
        if len(self._newest) > _STREAMS:
            self._newest.popitem(last=False)

    def _decode(self, payload: bytes) -> LowCommand:
        try:
            return decode_low_command(payload)
        except FrameError as error:
            raise RefusedMessageError("bytes", str(error)) from error

    def _check_holder(self, echo: Echo) -> None:
        if self._holder is not None and echo.stream != self._holder:
            raise RefusedMessageError(
                "holder",
                "another controller commands the robot, so this one is refused; end the other run first",
            )

    def _hand_over(self, echo: Echo, damping: bool) -> None:
        self._check_holder(echo)
        if self._holder is None:
            if not damping:
                raise RefusedMessageError(
                    "handover",
                    f"a new controller must begin with damping (kp 0, kd above 0): {self.reason}",
                )
            self._become(Control.CONTROLLED, "a controller took the robot over")
            self._holder = echo.stream

    def _gives_back(self, message: Message) -> bool:
        try:
            request = decode_request(message.payload)
        except FrameError as error:
            raise RefusedMessageError("bytes", str(error)) from error
        service = _REQUESTS[message.channel]
        return (service, request.api) == (SWITCHER, SELECT_MODE) or (
            (service, request.api) == (ROBOT_STATE, SERVICE_SWITCH) and _switches_on(request)
        )


def _switches_on(request: Request) -> bool:
    try:
        asked = json.loads(request.parameter)
    except (ValueError, RecursionError):
        return False
    return isinstance(asked, dict) and bool(asked.get("switch"))
