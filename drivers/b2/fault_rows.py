"""Fault tables of the B2; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.fault_rows import ON_STAND, unitree_table

B2: Final = unitree_table("b2", "FL_calf_joint")
B2_ON_STAND: Final = unitree_table("b2_on_stand", "FL_calf_joint", ON_STAND)
