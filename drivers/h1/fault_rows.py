"""Fault table of the H1; see :mod:`deal_hw.testing.fault_rows`."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.fault_rows import ON_CRANE, unitree_table

H1: Final = unitree_table("h1", "left_knee_joint", ON_CRANE)
