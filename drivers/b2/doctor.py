"""Checks of a B2 and the connection to it: listens, and asks which mode is active; no motor command."""

from __future__ import annotations

from typing import ClassVar

from deal_hw.drivers.b2.description import SUPPLY
from deal_hw.drivers.b2.robot import WORDING, B2Refusals
from deal_hw.drivers.go2.doctor import Go2Doctor
from deal_hw.drivers.go2.messages.refusals import Refusals
from deal_hw.drivers.unitree.supply import Supply
from deal_hw.drivers.unitree.wording import Wording


class B2Doctor(Go2Doctor):
    """Listens to a B2 and asks its motion switcher."""

    wording: ClassVar[Wording] = WORDING
    supply: ClassVar[Supply] = SUPPLY
    refusals: ClassVar[type[Refusals]] = B2Refusals
    kind: ClassVar[str] = "B2"
