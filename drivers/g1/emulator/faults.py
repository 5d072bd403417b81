"""Faults of an emulated G1 on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.drivers.g1.joints import MOTORS
from deal_hw.drivers.unitree import hung_faults
from deal_hw.drivers.unitree.emulated_faults import WirePlan
from deal_hw.drivers.unitree.hung_faults import HungFaults

MOMENTS: Final = (*hung_faults.MOMENTS, "error", "machine")
"""Faults with a start time, as in ``<name>_after_s``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class G1Faults(HungFaults):
    """Faults of an emulated G1; times count from the first stiff command."""

    KIND: ClassVar[str] = "G1"
    JOINTS: ClassVar[Sequence[str]] = MOTORS

    error_after_s: float | None = None
    """Time after which a motor reports an error [s]."""

    machine_after_s: float | None = None
    """Time after which the states have another mode_machine [s]."""


@dataclass(frozen=True, kw_only=True)
class G1FaultPlan(G1Faults, WirePlan):
    """All faults of an emulated G1: those of every emulated robot, and its own."""

    MOMENTS: ClassVar[tuple[str, ...]] = MOMENTS
