"""Checks of an H1 and the connection to it: listens, and asks which mode is active; no motor command."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.go2.messages.refusals import StateCheck
from deal_hw.drivers.h1.messages import H1Refusals, H1StateDecoder
from deal_hw.drivers.h1.robot import WORDING
from deal_hw.drivers.unitree.crane import CONTROLLER, LEVEL, RELEASED
from deal_hw.drivers.unitree.doctor import UnitreeDoctor
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.go_messages.robot_kind import humanoid_complaint
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.findings import Finding, Severity
from deal_hw.transport import TopicTransport

WARM_C = 70


class H1Doctor(UnitreeDoctor[LowStateFrame]):
    """Listens to an H1 and asks its motion switcher.

    Args:
        link: A transport of topics, not opened.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
        state_check: What a state must pass.
    """

    wording: ClassVar[Wording] = WORDING
    kind: ClassVar[str] = "H1"
    controller: ClassVar[str] = CONTROLLER
    released: ClassVar[str] = RELEASED
    level: ClassVar[str] = LEVEL

    def __init__(
        self, link: TopicTransport, clock: Clock, seconds: float, state_check: StateCheck = "strict"
    ) -> None:
        super().__init__(link, clock, seconds)
        self._decoder, self._strict = H1StateDecoder(), state_check == "strict"

    def _make_refusals(self) -> H1Refusals:
        return H1Refusals()

    def _decode(self, payload: bytes) -> LowStateFrame:
        return self._decoder.decode(payload, self._strict)

    def _judge_motors(self, frame: LowStateFrame) -> Iterator[Finding]:
        if wrong := humanoid_complaint(frame.payload):
            yield Finding("robot", Severity.FAIL, wrong, "choose the robot that it is")
        hottest = int(np.max(frame.temperature))
        yield Finding.judged("robot", hottest > WARM_C, f"hottest motor {hottest} °C", "let it cool down")
