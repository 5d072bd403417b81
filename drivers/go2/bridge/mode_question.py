"""Asks which mode controls the robot, without waiting for the answer: the bridge has commands to check."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.go2.bridge.robot_side import BUSY
from deal_hw.drivers.go2.messages.rpc import Request, decode_response, encode_request
from deal_hw.drivers.go2.motion_switcher import BUSY as BUSY_CODE
from deal_hw.drivers.go2.motion_switcher import CHECK_MODE, SWITCHER
from deal_hw.drivers.transports import topics
from deal_hw.errors import FrameError
from deal_hw.transport import Message

_RESPONSE: Final = topics.response(SWITCHER)


class ModeQuestion:
    """The newest question to ``motion_switcher``, and its answer.

    One thread asks; another one may take the robot's messages.
    """

    def __init__(self) -> None:
        self._identity = 0
        self._answer: tuple[int, str] | None = None

    def ask(self, now_ns: int) -> bytes:
        """Return the payload of a new question; the answer to the one before does not count any more.

        Args:
            now_ns: The bridge's clock, from which the question has its number [ns].
        """
        self._identity = max(self._identity + 1, now_ns)
        return encode_request(Request(self._identity, CHECK_MODE, "{}"))

    def take(self, message: Message) -> None:
        """Take a message of the robot's side; answers to other programs, and errors, are skipped."""
        if message.channel != _RESPONSE:
            return
        try:
            response = decode_response(message.payload)
            name = BUSY if response.code == BUSY_CODE else response.json().get("name")
        except FrameError:
            return
        if response.code in (0, BUSY_CODE) and isinstance(name, str):
            self._answer = response.identity, name

    def answer(self) -> str | None:
        """Return the active mode's name by the answer to the newest question, once; None without one."""
        answer, self._answer = self._answer, None
        return answer[1] if answer is not None and answer[0] == self._identity else None
