"""The B2 over topics: the Go2's driver with a B2's numbers."""

from __future__ import annotations

from typing import ClassVar, Final

from deal_hw.description import RobotDescription
from deal_hw.drivers.b2.description import DESCRIPTION, ON_STAND, SERVO_MODE, SUPPLY, SUPPORT
from deal_hw.drivers.go2.messages.refusals import Refusals
from deal_hw.drivers.go2.robot import Go2Robot
from deal_hw.drivers.unitree.claim import WireClaim
from deal_hw.drivers.unitree.supply import Supply
from deal_hw.drivers.unitree.support import SupportConfig
from deal_hw.drivers.unitree.wording import Wording

WORDING: Final = Wording(
    name="b2",
    free="lay the robot down by its remote, or switch sport mode off in the vendor's app",
    quiet="lay it down or damp it by its remote",
    off="if it is the robot's own sport mode, switch that off in the vendor's app",
)


class B2Refusals(Refusals):
    """Counts refused states of a B2."""

    robot: ClassVar[tuple[str, str]] = ("b2", "B2")


class B2Claim(WireClaim):
    """A claim on a B2."""

    robot: ClassVar[str] = "b2"


class B2Robot(Go2Robot):
    """A Unitree B2 at its motors' own level, on the floor."""

    description: ClassVar[RobotDescription] = DESCRIPTION
    stopped_by: ClassVar[str] = "its own remote (damping) or its power switch"
    wording: ClassVar[Wording] = WORDING
    refusals: ClassVar[type[Refusals]] = B2Refusals
    supply: ClassVar[Supply] = SUPPLY
    servo_mode: ClassVar[int] = SERVO_MODE
    support: ClassVar[SupportConfig] = SUPPORT
    other_support: ClassVar[str] = "b2_on_stand"


class B2OnStandRobot(B2Robot):
    """A B2 with its base on a stand, or hung up."""

    description: ClassVar[RobotDescription] = ON_STAND
    other_support: ClassVar[str] = "b2"
