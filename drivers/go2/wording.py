"""What messages of the shared driver say of a Go2."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.wording import Wording

WORDING: Final = Wording(
    name="go2",
    free="lay the robot down by its remote, or switch sport mode off in the vendor's app",
    quiet="lay it down or damp it by its remote",
    off="if it is the robot's own sport mode, switch that off in the vendor's app",
)
