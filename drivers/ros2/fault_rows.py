"""Fault tables of robots of ros2_control; see :mod:`deal_hw.testing.fault_rows`.

In virtual time a wire carries the same messages over DDS and over Zenoh, so there is one table for both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from deal_hw.testing.fault_rows import (
    CLOCK_AHEAD,
    CLOCK_BACK,
    CONNECTING,
    CONTROLLER_OFF,
    CUT,
    DUPLICATE,
    FOREIGN,
    HOMING,
    NO_TIME_YET,
    NOT_ARMED,
    PLANNED_END,
    RETURN_S,
    RUNNING,
    WAITS,
    Expected,
    FaultRig,
    FaultRow,
    FaultTable,
    Lacks,
    killed_cells,
    returned_cells,
)

_FOREIGN_HZ: Final = 47.0
"""No multiple of the control rate: in virtual time its commands would always come just before ours."""
_START_RAD_S: Final = 0.77
"""Homing goes at 0.5 rad/s, and the emulated drives, lightly damped, reach nearly twice that."""
_ASIDE: Final = 0.2
"""How far aside another program wants the joints [rad]."""


def _switch_off(rig: FaultRig) -> None:
    rig.device.switch(active=False)


def _switch_on(rig: FaultRig) -> None:
    rig.device.switch(active=True)


def _begin_foreign(rig: FaultRig) -> None:
    device = rig.device
    topic, payload = device.command_aside(_ASIDE)
    rig.world.every(1.0 / _FOREIGN_HZ, lambda: rig.world.publish(topic, payload))


def _end_foreign(rig: FaultRig) -> None:
    rig.world.calm()


def _ahead(rig: FaultRig) -> None:
    rig.device.jump_clock(2.0)


def _back(rig: FaultRig) -> None:
    rig.device.jump_clock(-5.0)


def _table(command: str, cells: Mapping[tuple[str, str], Expected] | None = None) -> FaultTable:
    return FaultTable(
        name=f"ros2 {command}",
        stiff=lambda device: True,
        target=lambda device: device.setpoint,
        start_speed=_START_RAD_S,
        phases={PLANNED_END: Lacks("its drives hold it: it has no rest pose")},
        rows={
            CONTROLLER_OFF: FaultRow(
                begin=_switch_off, mend=_switch_on, lasts_s=2.0, cells=killed_cells(homes_by_motor=True)
            ),
            FOREIGN: FaultRow(
                begin=_begin_foreign,
                mend=_end_foreign,
                lasts_s=1.0,
                cells=returned_cells(homes_by_motor=True),
            ),
            DUPLICATE: Lacks("its joints have names"),
            CLOCK_AHEAD: FaultRow(begin=_ahead, cells=killed_cells(homes_by_motor=True)),
            CLOCK_BACK: FaultRow(begin=_back, cells=killed_cells(homes_by_motor=True)),
        },
        cells={
            (CUT, CONNECTING): WAITS,
            (FOREIGN, CONNECTING): Expected(
                end="passive",
                within_s=RETURN_S,
                since="return",
                why="the run is refused; the other program moves the joints as long as it likes",
            ),
            (CLOCK_AHEAD, CONNECTING): NO_TIME_YET,
            (CLOCK_AHEAD, HOMING): NOT_ARMED,
            (CLOCK_BACK, CONNECTING): NO_TIME_YET,
            **(cells or {}),
        },
    )


POSITION: Final = _table("position")
TRAJECTORY: Final = _table(
    "trajectory",
    {
        (CONTROLLER_OFF, RUNNING): Expected(
            end="passive",
            within_s=RETURN_S,
            since="return",
            why="an inactive controller takes no command: it gets the pose to hold when it is back",
        )
    },
)
