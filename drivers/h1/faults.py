"""Faults of an emulated H1 on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from deal_hw.drivers.h1.joints import JOINTS
from deal_hw.drivers.unitree import hung_faults
from deal_hw.drivers.unitree.emulated_faults import WirePlan
from deal_hw.drivers.unitree.hung_faults import HungFaults

MOMENTS: Final = (*hung_faults.MOMENTS, "lost")
"""Faults with a start time, as in ``<name>_after_s``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class H1Faults(HungFaults):
    """Faults of an emulated H1; times count from the first stiff command."""

    KIND: ClassVar[str] = "H1"
    JOINTS: ClassVar[Sequence[str]] = JOINTS

    lost_after_s: float | None = None
    """Time after which a motor gets no commands any more and is limp [s]."""


@dataclass(frozen=True, kw_only=True)
class H1FaultPlan(H1Faults, WirePlan):
    """All faults of an emulated H1: those of every emulated robot, and its own."""

    MOMENTS: ClassVar[tuple[str, ...]] = MOMENTS
