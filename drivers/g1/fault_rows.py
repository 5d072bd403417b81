"""Fault table of the G1; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.fault_rows import HANGING, is_stiff, unitree_rows
from deal_hw.testing.fault_rows import PLANNED_END, FaultTable, Lacks

G1: Final = FaultTable(
    name="g1",
    stiff=is_stiff,
    homes_by_motor=False,
    start_speed=3.0,
    joint="left_knee_joint",
    phases={PLANNED_END: Lacks("it hangs on a crane: its limbs are damped when the run is over")},
    may_not_show=HANGING,
    rows=unitree_rows(),
)
