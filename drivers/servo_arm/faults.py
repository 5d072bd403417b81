"""Faults of an emulated arm's servos; the command line has them as options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.ranges import Range


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmFaults(BusFaults):
    """Faults of one servo of an emulated arm, and of its bus."""

    faulty_servo: Annotated[int | None, Range(0, 253)] = None
    """Id of the servo that has the faults; by default that of the last joint."""

    servo_absent_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo's plug is pulled after this time: it has no supply and is silent [s]."""

    servo_reboot_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo restarts after this time, as after a dip of its supply [s]."""

    servo_overload_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo reports an overload after this time: Dynamixel gives no torque any more, Feetech less [s]."""
