"""Fault tables of the Go2; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.fault_rows import HANGING, is_stiff, unitree_rows
from deal_hw.testing.fault_rows import PLANNED_END, FaultTable, Lacks

GO2: Final = FaultTable(
    name="go2",
    stiff=is_stiff,
    homes_by_motor=False,
    start_speed=3.0,
    joint="FL_calf_joint",
    rows=unitree_rows(),
)
GO2_ON_STAND: Final = FaultTable(
    name="go2_on_stand",
    stiff=is_stiff,
    homes_by_motor=False,
    start_speed=3.0,
    joint="FL_calf_joint",
    phases={PLANNED_END: Lacks("on a stand it has no way to go: its legs hang when the run is over")},
    may_not_show=HANGING,
    rows=unitree_rows(),
)
