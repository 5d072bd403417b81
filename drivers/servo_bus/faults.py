"""Faults of an emulated bus of servos; the command line has them as options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from deal_hw.ranges import Checked, Range


@dataclass(frozen=True, slots=True, kw_only=True)
class BusFaults(Checked):
    """Faults of an emulated bus of servos, whose times count from the first torque on all motors."""

    duplicate_id_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Servos: a second one with the faulty servo's id is plugged in after this time; both answer at once
    [s]."""

    foreign_writer_after_s: Annotated[float | None, Range(0, 1e7, "s")] = None
    """Servos: another program begins to write goals to the faulty servo after this time, through the same
    port [s]."""

    foreign_rate_hz: Annotated[float, Range(0.1, 200, "Hz")] = 60.0
    """Servos: how often the other program writes [Hz]."""

    foreign_on_line: bool = False
    """Servos: the other program has an adapter of its own on the bus, so that its packets are received here,
    too."""
