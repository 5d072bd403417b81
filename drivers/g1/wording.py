"""What messages of the shared driver say of a G1."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.unitree.wording import Wording

WORDING: Final = Wording(
    name="g1",
    free="press L2 and R2 on its remote while it hangs (debug mode: its joints are damped)",
    quiet="press L2 and R2 on its remote while it hangs (debug mode: its joints are damped)",
    off="if it is the robot's own controller, press L2 and R2 on its remote while it hangs (debug mode)",
)
