"""Faults of an emulated arm's servos; the command line has them as options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from deal_hw.ranges import Checked, Range


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmFaults(Checked):
    """Faults of one servo of an emulated arm, whose times count from the first torque on all motors."""

    faulty_servo: Annotated[int | None, Range(0, 253)] = None
    """Id of the servo that has the faults; by default that of the last joint."""

    servo_absent_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo's plug is pulled after this time: it has no supply and is silent [s]."""

    servo_reboot_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo restarts after this time, as after a dip of its supply [s]."""

    servo_overload_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """The servo reports an overload after this time: Dynamixel gives no torque any more, Feetech less [s]."""

    duplicate_id_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """A second servo with the servo's id is plugged in after this time: both answer at once [s]."""

    foreign_writer_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Another program begins to write goals to the servo after this time, through the same port [s]."""

    foreign_rate_hz: Annotated[float, Range(0.1, 200, "Hz")] = 60.0
    """How often the other program writes [Hz]."""

    foreign_on_line: bool = False
    """The other program has an adapter of its own on the bus, so that its packets are received here, too."""
