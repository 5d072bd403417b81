"""Checks of a G1 and the connection to it: listens, and asks which mode is active; no motor command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np

from deal_hw.clock import Clock
from deal_hw.drivers.g1.joints import JOINTS_29, MACHINES, ROBOT_OF
from deal_hw.drivers.g1.messages import G1Frame, G1StateDecoder
from deal_hw.drivers.g1.refusals import G1Refusals
from deal_hw.drivers.g1.wording import WORDING
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.crane import CONTROLLER, LEVEL, RELEASED
from deal_hw.drivers.unitree.doctor import UnitreeDoctor
from deal_hw.drivers.unitree.wording import Wording
from deal_hw.findings import Finding, Severity
from deal_hw.transport import TopicTransport

WARM_CASING_C, WARM_WINDING_C = 70, 100


class G1Doctor(UnitreeDoctor[G1Frame]):
    """Listens to a G1 of any version and asks its motion switcher.

    Args:
        link: A transport of topics, not opened.
        clock: The clock of its stamps.
        seconds: How long to listen [s].
    """

    wording: ClassVar[Wording] = WORDING
    kind: ClassVar[str] = "G1"
    types: ClassVar[Mapping[str, str]] = topics.HUMANOID_TYPES
    controller: ClassVar[str] = CONTROLLER
    released: ClassVar[str] = RELEASED
    level: ClassVar[str] = LEVEL

    def __init__(self, link: TopicTransport, clock: Clock, seconds: float) -> None:
        super().__init__(link, clock, seconds)
        self._decoder = G1StateDecoder(JOINTS_29)

    def _make_refusals(self) -> G1Refusals:
        return G1Refusals()

    def _decode(self, payload: bytes) -> G1Frame:
        return self._decoder.decode(payload)

    def _judge_motors(self, frame: G1Frame) -> Iterator[Finding]:
        machine = frame.mode_machine
        fits = ROBOT_OF.get(machine)
        what = f"mode_machine {machine}: {MACHINES.get(machine, 'an unknown version')}"
        if fits is None:
            yield Finding("robot", Severity.FAIL, what, f"deal-hw describes only {sorted(ROBOT_OF)}")
        else:
            yield Finding("robot", Severity.OK, f"{what}; here it is robot `{fits}`")
        if (error := frame.error).any():
            names = ", ".join(
                f"{joint} 0x{code:X}" for joint, code in zip(JOINTS_29, error, strict=True) if code
            )
            yield Finding("robot", Severity.FAIL, f"motors report errors: {names}", "restart the robot")
        casing, winding = int(np.max(frame.casing)), int(np.max(frame.winding))
        hot = casing > WARM_CASING_C or winding > WARM_WINDING_C
        yield Finding.judged(
            "robot", hot, f"hottest casing {casing} °C, hottest winding {winding} °C", "let it cool down"
        )
