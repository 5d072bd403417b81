"""Faults of an emulated humanoid on a crane, on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Final

from deal_hw.errors import ConfigurationError, UnknownNameError

MOMENTS: Final = ("freeze", "cut", "sport", "nan", "hot", "stop")
"""Faults of every emulated humanoid with a start time, as in ``<name>_after_s``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HungFaults:
    """Faults of an emulated humanoid; times count from the first stiff command."""

    KIND: ClassVar[str]
    JOINTS: ClassVar[Sequence[str]]

    sport_after_s: float | None = None
    """Time after which the robot's own controller comes back [s]."""

    nan_after_s: float | None = None
    """Time after which a joint's position and velocity are NaN [s]."""

    hot_after_s: float | None = None
    """Time after which a motor reports 130 °C (a G1's winding) [s]."""

    fault_joint: str = "left_knee_joint"
    """The joint of a fault that has one."""

    stop_after_s: float | None = None
    """Time after which the operator holds L2 and B [s]."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name.endswith("_after_s") and value is not None and not 0.0 <= value <= 1e7:
                raise ConfigurationError(f"{entry.name} must be 0 to 1e7 seconds, got {value}")
        if self.fault_joint not in self.JOINTS:
            raise UnknownNameError(f"{self.KIND} joint", self.fault_joint, self.JOINTS)
