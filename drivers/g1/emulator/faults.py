"""Faults of an emulated G1 on request."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Final

from deal_hw.drivers.g1.joints import MOTORS
from deal_hw.drivers.unitree.emulated_faults import WirePlan
from deal_hw.errors import ConfigurationError, UnknownNameError

MOMENTS: Final = ("freeze", "cut", "sport", "nan", "hot", "error", "stop", "machine")
"""Faults with a start time, as in ``<name>_after_s``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class G1Faults:
    """Faults of an emulated G1; times count from the first stiff command."""

    sport_after_s: float | None = None
    """Time after which the robot's own controller comes back [s]."""

    nan_after_s: float | None = None
    """Time after which a joint's position and velocity are NaN [s]."""

    hot_after_s: float | None = None
    """Time after which a motor's winding reports 130 °C [s]."""

    error_after_s: float | None = None
    """Time after which a motor reports an error [s]."""

    fault_joint: str = "left_knee_joint"
    """The joint of the last three faults."""

    stop_after_s: float | None = None
    """Time after which the operator holds L2 and B [s]."""

    machine_after_s: float | None = None
    """Time after which the states have another mode_machine [s]."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name.endswith("_after_s") and value is not None and not 0.0 <= value <= 1e7:
                raise ConfigurationError(f"{entry.name} must be 0 to 1e7 seconds, got {value}")
        if self.fault_joint not in MOTORS:
            raise UnknownNameError("G1 joint", self.fault_joint, MOTORS)


@dataclass(frozen=True, kw_only=True)
class G1FaultPlan(G1Faults, WirePlan):
    """All faults of an emulated G1: those of every emulated robot, and its own."""

    MOMENTS: ClassVar[tuple[str, ...]] = MOMENTS
