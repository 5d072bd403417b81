"""Rows of a fault table that Unitree's robots share."""

from __future__ import annotations

from typing import Any, Final

from deal_hw.drivers.transports.topics import LOW_COMMAND
from deal_hw.testing.fault_rows import (
    ARMING,
    BOTH_KILLED,
    CLOCK_AHEAD,
    CLOCK_BACK,
    CONNECTING,
    CONTROLLER_OFF,
    CUT,
    DUPLICATE,
    FOREIGN,
    FROZEN,
    HOMING,
    NO_TIME_YET,
    NOT_ARMED,
    PHASES,
    PLANNED_END,
    RETURN_S,
    WAITS,
    Expected,
    FaultRig,
    FaultRow,
    FaultTable,
    Lacks,
    killed_cells,
    returned_cells,
)

FOREIGN_S: Final = 1.0
"""How long another program commands the robot [s]."""
ON_STAND: Final = "on a stand it has no way to go: its legs hang when the run is over"
"""Why a legged robot on a stand has no planned end."""
ON_CRANE: Final = "it hangs on a crane: its limbs are damped when the run is over"
"""The same of a humanoid."""
_HANGING: Final = {FROZEN: "limbs that hang free stay near the set-points of a small motion"}
"""What may not show on a stand or a crane, and why."""
_RELEASED: Final = Expected(end="goes on", why="homing releases the robot's own controller")
_SILENT: Final = Expected(end="goes on", why="homing waits until no other program commands for half a second")
_PUSHED: Final = Expected(
    end="passive",
    within_s=RETURN_S,
    since="return",
    why="legs that another program moves push as on the floor: the run is refused",
)
_ON_LEGS: Final = {
    (CUT, HOMING): Expected(
        end="goes on", why="homing commands nothing, and waits longer than the fault lasts"
    ),
    (FROZEN, PLANNED_END): Expected(
        end="passive or over", within_s=6.0, why="it shows when the robot lies down, at the end"
    ),
}
"""Cells of a robot with four legs that differ."""
_FOREIGN_HZ: Final = 47.0
"""No multiple of the control rate: in virtual time its commands would always come just before ours."""


def _begin_foreign(rig: FaultRig) -> None:
    payload = rig.device.command_aside()
    rig.world.every(1.0 / _FOREIGN_HZ, lambda: rig.world.publish(LOW_COMMAND, payload))


def _end_foreign(rig: FaultRig) -> None:
    rig.world.calm()


def _begin_own(rig: FaultRig) -> None:
    rig.device.begin_fault("sport")


def _end_own(rig: FaultRig) -> None:
    rig.device.leave_own()


def _ahead(rig: FaultRig) -> None:
    rig.device.jump_clock(2.0)


def _back(rig: FaultRig) -> None:
    rig.device.jump_clock(-5.0)


def unitree_rows() -> dict[str, FaultRow | Lacks]:
    """Return the rows that differ from those of every robot."""
    contested = returned_cells(homes_by_motor=False)
    clock = killed_cells(homes_by_motor=False)
    return {
        CONTROLLER_OFF: FaultRow(begin=_begin_own, mend=_end_own, lasts_s=FOREIGN_S, cells=contested),
        FOREIGN: FaultRow(begin=_begin_foreign, mend=_end_foreign, lasts_s=FOREIGN_S, cells=contested),
        BOTH_KILLED: FaultRow(
            cells={
                **dict.fromkeys(PHASES, Expected(end="holds", why="nobody is left who could damp it")),
                **dict.fromkeys((CONNECTING, HOMING, ARMING), Expected(end="untouched")),
            }
        ),
        DUPLICATE: Lacks("its motors have no ids on a wire that deal-hw sees"),
        CLOCK_AHEAD: FaultRow(begin=_ahead, cells=clock),
        CLOCK_BACK: FaultRow(begin=_back, cells=clock),
    }


def unitree_table(name: str, joint: str, hangs: str = "") -> FaultTable:
    """Return the fault table of a robot.

    Args:
        name: The robot.
        joint: The joint whose reading is wrong.
        hangs: Why it has no planned end, where its limbs hang in the air; "": it stands on the floor.
    """
    return FaultTable(
        name=name,
        stiff=is_stiff,
        homes_by_motor=False,
        start_speed=3.0,
        may_fall=not hangs,
        joint=joint,
        phases={PLANNED_END: Lacks(hangs)} if hangs else {},
        may_not_show=_HANGING if hangs else {},
        rows=unitree_rows(),
        cells={
            (CUT, CONNECTING): WAITS,
            (CONTROLLER_OFF, CONNECTING): _RELEASED,
            (CONTROLLER_OFF, HOMING): _RELEASED,
            (FOREIGN, CONNECTING): _SILENT,
            (FOREIGN, HOMING): _SILENT,
            (CLOCK_AHEAD, CONNECTING): NO_TIME_YET,
            (CLOCK_AHEAD, HOMING): NOT_ARMED,
            (CLOCK_BACK, CONNECTING): NO_TIME_YET,
            **({} if hangs == ON_CRANE else _ON_LEGS),
            **({(FOREIGN, CONNECTING): _PUSHED, (FOREIGN, HOMING): _PUSHED} if hangs == ON_STAND else {}),
        },
    )


def is_stiff(device: Any) -> bool:
    """Return whether an emulated robot's motors follow commands."""
    return bool(device.stiff)
