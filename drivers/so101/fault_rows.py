"""Fault table of the SO-101; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from deal_hw.drivers.servo_arm.fault_rows import ARM_CELLS, arm_rows, is_stiff
from deal_hw.testing.fault_rows import (
    CUT,
    DUPLICATE,
    FOREIGN,
    OUT_OF_RANGE,
    PLANNED_END,
    RETURN_S,
    SOON_S,
    Expected,
    FaultTable,
)

_OVER: Final = Expected(
    end="passive or over",
    within_s=SOON_S,
    why="the motion is over and recorded; the arm is not lowered further",
)
SO101: Final = FaultTable(
    name="so101",
    stiff=is_stiff,
    start_speed=0.5,
    rows=arm_rows(),
    cells={
        **ARM_CELLS,
        **{(fault, PLANNED_END): _OVER for fault in (FOREIGN, DUPLICATE, OUT_OF_RANGE)},
        (CUT, PLANNED_END): replace(_OVER, within_s=RETURN_S, since="return"),
    },
)
