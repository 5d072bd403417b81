"""Fault table of the G1; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.fault_rows import ON_CRANE, unitree_table

G1: Final = unitree_table("g1", "left_knee_joint", ON_CRANE)
