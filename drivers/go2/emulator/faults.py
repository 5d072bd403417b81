"""Faults of an emulated Go2 on request: on the wire, in the firmware, in the motors, around it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Final

from deal_hw.drivers.go2.descriptions.floor import JOINTS
from deal_hw.drivers.unitree.emulated_faults import SHARES, WirePlan
from deal_hw.errors import ConfigurationError, UnknownNameError

MOMENTS: Final = (
    "wire",
    "freeze",
    "cut",
    "stale",
    "lost",
    "sport",
    "battery",
    "nan",
    "hot",
    "stop",
    "push",
)
"""Faults with a start time, as in ``<name>_after_s``; ``wire`` is the start of the four shares."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Go2Faults:
    """Faults of an emulated Go2; times count from the first stiff command."""

    reorder: float = 0.0
    """Share of states that arrive after their successor."""

    wire_after_s: float | None = None
    """Start of --drop, --duplicate, --reorder and --corrupt [s]; by default at once."""

    stale_after_s: float | None = None
    """Time after which the same state is sent again and again [s]."""

    lost_after_s: float | None = None
    """Time after which a motor gives no torque and counts lost commands [s]."""

    lost_joint: str = "FL_calf_joint"
    """The motor of this fault."""

    sport_after_s: float | None = None
    """Time after which sport mode comes back and stands the robot up [s]."""

    battery_after_s: float | None = None
    """Time after which the battery is nearly empty [s]."""

    nan_after_s: float | None = None
    """Time after which a joint's position and velocity are NaN [s]."""

    nan_joint: str = "FL_calf_joint"
    """The joint of this fault."""

    hot_after_s: float | None = None
    """Time after which a motor reports 95 °C [s]."""

    hot_joint: str = "FL_calf_joint"
    """The motor of this fault."""

    stop_after_s: float | None = None
    """Time after which the operator holds L2 and B [s]."""

    push_after_s: float | None = None
    """Time of a push of the base to its left [s]."""

    push: float = 25.0
    """The push's impulse, over 0.1 s [N*s]."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in SHARES and not 0.0 <= value <= 1.0:
                raise ConfigurationError(f"{entry.name} is a share from 0 to 1, got {value}")
            if entry.name.endswith("_after_s") and value is not None and not 0.0 <= value <= 1e7:
                raise ConfigurationError(f"{entry.name} must be 0 to 1e7 seconds, got {value}")
            if entry.name == "push" and not abs(value) <= 1e4:
                raise ConfigurationError(f"push must be -1e4 to 1e4 N*s, got {value}")
            if entry.name.endswith("_joint") and value not in JOINTS:
                raise UnknownNameError("Go2 joint", value, JOINTS)


@dataclass(frozen=True, kw_only=True)
class FaultPlan(Go2Faults, WirePlan):
    """All faults of an emulated Go2: those of every emulated robot, and its own."""

    MOMENTS: ClassVar[tuple[str, ...]] = MOMENTS
