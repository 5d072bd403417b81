"""Fault tables of arms of servos; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from deal_hw.drivers.servo_arm.families import ON
from deal_hw.drivers.servo_bus.faults import BusFaults
from deal_hw.testing.fault_rows import (
    ARMING,
    CLOCK_AHEAD,
    CLOCK_BACK,
    CONNECTING,
    CONTROLLER_OFF,
    CUT,
    DUPLICATE,
    EXCHANGED,
    FOREIGN,
    FROZEN,
    HOMING,
    LIMP,
    OUT_OF_RANGE,
    PLANNED_END,
    RETURN_S,
    SOON_S,
    Expected,
    FaultRig,
    FaultRow,
    FaultTable,
    Lacks,
    killed_cells,
)

_NO_CLOCK: Final = Lacks("its servos have no clock: times are this computer's")


def is_stiff(device: Any) -> bool:
    """Return whether a motor follows its goals; one that its own watchdog stopped holds where it is."""
    return any(joint.torque == ON and not joint.stopped for joint in device.joints)


def _double(rig: FaultRig) -> None:
    rig.device.double(rig.device.joints[-1])


def _let_write(rig: FaultRig) -> None:
    rig.device.let_write(rig.device.joints[-1], BusFaults())


def _mend(rig: FaultRig) -> None:
    rig.device.mend_bus()


def arm_rows() -> dict[str, FaultRow | Lacks]:
    """Return the rows that differ from those of every robot."""
    cells = killed_cells(homes_by_motor=True)
    return {
        CONTROLLER_OFF: Lacks("its servos are its only controllers, and a restart takes their torque"),
        FOREIGN: FaultRow(begin=_let_write, mend=_mend, lasts_s=1.0, cells=cells),
        DUPLICATE: FaultRow(begin=_double, mend=_mend, cells=cells),
        CLOCK_AHEAD: _NO_CLOCK,
        CLOCK_BACK: _NO_CLOCK,
    }


_OVER: Final = Expected(
    end="passive or over",
    within_s=SOON_S,
    why="the motion is over and recorded; the arm is not lowered further",
)
ARM_CELLS: Final = {
    **{(fault, PLANNED_END): _OVER for fault in (FOREIGN, DUPLICATE, OUT_OF_RANGE)},
    (CUT, PLANNED_END): replace(_OVER, within_s=RETURN_S, since="return"),
    (FOREIGN, CONNECTING): Expected(
        end="passive",
        within_s=SOON_S,
        since="first command",
        why="a strange goal may be an old one, until this run has written its own",
    ),
    (DUPLICATE, ARMING): Expected(
        end="passive",
        within_s=1.0 + SOON_S,
        why="it holds its start pose while the arming waits for a sound state",
    ),
}
"""Cells that differ from their rows."""
_START_RAD_S: Final = 0.75
"""Homing goes at 0.5 rad/s, and the emulated drives swing about it."""
_MAY_NOT_SHOW: Final = {
    EXCHANGED: "two readings of this small motion hardly differ",
    LIMP: "the motion swells: early in it the joints stay near their set-points without torque",
}
_CELLS: Final = {
    **ARM_CELLS,
    (FROZEN, PLANNED_END): Expected(
        end="passive or over",
        within_s=20.0 + SOON_S,
        why="by its reading it still moves, so it stays stiff in its rest pose for the longest time",
    ),
}
_PHASES: Final[Mapping[str, float | Lacks]] = {HOMING: 0.01, PLANNED_END: 0.01}
"""It is switched on in its start pose, so homing is short, and so is the way back to it."""


FEETECH: Final = FaultTable(
    name="arm feetech",
    stiff=is_stiff,
    start_speed=_START_RAD_S,
    phases=_PHASES,
    may_not_show=_MAY_NOT_SHOW,
    rows=arm_rows(),
    cells=_CELLS,
)
DYNAMIXEL: Final = FaultTable(
    name="arm dynamixel",
    stiff=is_stiff,
    watchdog_s=0.2,
    start_speed=_START_RAD_S,
    phases=_PHASES,
    may_not_show=_MAY_NOT_SHOW,
    rows=arm_rows(),
    cells=_CELLS,
)
