"""Checks of a Go2 and the connection to it: listens, and asks which mode is active; no motor command."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.go2.descriptions.driver import SUPPLY
from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.go2.messages.refusals import Refusals, StateCheck
from deal_hw.drivers.go2.messages.simulated import NOTICE, Simulator, decode_simulated
from deal_hw.drivers.go2.wording import WORDING
from deal_hw.drivers.unitree.doctor import Received, UnitreeDoctor
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.go_messages.robot_kind import quadruped_complaint
from deal_hw.drivers.unitree.supply import Supply
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.findings import Finding, Severity
from deal_hw.transport import Message, TopicTransport


class Go2Doctor(UnitreeDoctor[LowStateFrame]):
    """Listens to a Go2 and asks its motion switcher.

    Attributes:
        supply: Its supply, which tells it from another robot with the same messages.
        refusals: Counts refused states.

    Args:
        link: A transport of topics, not opened.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
        state_check: What a state must pass.
        simulator: Name of a simulator in place of the robot; None for a robot.
    """

    wording: ClassVar[Wording] = WORDING
    supply: ClassVar[Supply] = SUPPLY
    refusals: ClassVar[type[Refusals]] = Refusals
    kind: ClassVar[str] = "Go2"
    controller: ClassVar[str] = "sport mode"
    released: ClassVar[str] = (
        "deal-hw releases it when it arms, after the robot has lain down; keep the robot on the floor"
    )
    level: ClassVar[str] = "set it down level"

    def __init__(
        self,
        link: TopicTransport,
        clock: Clock,
        seconds: float,
        state_check: StateCheck = "strict",
        simulator: Simulator = "none",
    ) -> None:
        super().__init__(link, clock, seconds)
        self._strict, self._simulated = state_check == "strict", simulator != "none"

    def _make_refusals(self) -> Refusals:
        return self.refusals()

    def _decode(self, payload: bytes) -> LowStateFrame:
        return decode_simulated(payload) if self._simulated else decode_low_state(payload, self._strict)

    def _keep(self, received: Received[LowStateFrame], message: Message, frame: LowStateFrame) -> None:
        if not self._simulated:
            super()._keep(received, message, frame)
        elif received.last is not None and received.last.payload == frame.payload:
            received.repeated += 1
        else:
            received.stamps.append(message.stamp_ns)
            received.last = frame

    def _beforehand(self) -> Iterator[Finding]:
        if self._simulated:
            yield Finding("states", Severity.NOTE, NOTICE.removeprefix("note: "))
        if not self._strict:
            yield Finding(
                "states",
                Severity.WARN,
                "head and checksum of the states are not checked",
                "leave --state-check out if the robot's head and checksum are as deal-hw expects",
            )

    def _asked_mode(self) -> Generator[Finding, None, str | None]:
        return "" if self._simulated else (yield from super()._asked_mode())

    def _judge_motors(self, frame: LowStateFrame) -> Iterator[Finding]:
        wrong = (quadruped_complaint(frame.payload, self.kind), self.supply.complaint(frame.voltage))
        for text in filter(None, wrong):
            yield Finding("robot", Severity.FAIL, text, "choose the robot that it is")
        if self._simulated:
            return
        charge = frame.battery_percent
        text = f"battery {charge} %, {frame.voltage:.1f} V, {frame.current:.1f} A"
        yield Finding.judged("robot", charge < 20, text, "charge it")
        hottest = int(np.max(frame.temperature))
        yield Finding.judged("robot", hottest > 70, f"hottest motor {hottest} °C", "let it cool down")
