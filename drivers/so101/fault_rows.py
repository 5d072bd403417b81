"""Fault table of the SO-101; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.servo_arm.fault_rows import ARM_CELLS, arm_rows, is_stiff
from deal_hw.testing.fault_rows import FaultTable

SO101: Final = FaultTable(
    name="so101",
    stiff=is_stiff,
    start_speed=0.5,
    rows=arm_rows(),
    cells=ARM_CELLS,
)
