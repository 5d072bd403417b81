"""Tells the robots with the messages unitree_go apart by the motor slots in which their states report.

All have 20 slots: a Go2 and a B2 use 0 to 11, a Go2-W and a B2-W have their wheels at 12 to 15, an H1 uses
all but 9. A slot without a motor holds zeros: a Go2's 12 to 19 do in the states printed in
hanlinniu/unitree_sdk2_python @ 4becdb1, example/low_level/motor_state_data_example_standup.py. What an H1
holds in slot 9 is not published, so no H1 is refused by it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.drivers.unitree.go_messages import layout

REAR_LEFT_HIP: Final = 9
"""Slot of a motor that a Go2 and a B2 have, and an H1 has not."""
WHEELS: Final = slice(12, 16)
"""Slots of an H1's right arm, or of wheels."""
LEFT_ARM: Final = slice(16, 20)
"""Slots that an H1 alone uses."""


def quadruped_complaint(payload: bytes, kind: str) -> str:
    """Return why a state is not that of a Go2 or B2; "" if it may be.

    Args:
        payload: A LowState, checked.
        kind: The robot that is expected, in a sentence.
    """
    if _reports(payload, LEFT_ARM):
        return (
            f"its motors 16 to 19 report, and a {kind} has none there: they are the left arm of an H1, which "
            "has the same messages; take robot `h1` if it is one"
        )
    if _reports(payload, WHEELS):
        return (
            f"its motors 12 to 15 report, and a {kind} has none there: they may be the wheels of a Go2-W or "
            "B2-W, for which deal-hw has no robot; do not command it"
        )
    if not _reports(payload, slice(REAR_LEFT_HIP, REAR_LEFT_HIP + 1)):
        return (
            f"its motor 9 reports neither position nor temperature: it is the left rear hip of a {kind}, and "
            "an H1, which has the same messages, has none there; take robot `h1` if it is one, or have that "
            "motor examined"
        )
    return ""


def humanoid_complaint(payload: bytes) -> str:
    """Return why a state is not that of an H1; "" if it may be.

    Args:
        payload: A LowState, checked.
    """
    if _reports(payload, LEFT_ARM):
        return ""
    return (
        "its motors 16 to 19, an H1's left arm, report neither position nor temperature, as those of a Go2 "
        "or B2, which have the same messages: take robot `go2` or `b2` if it is one"
    )


def _reports(payload: bytes, slots: slice) -> bool:
    """Return whether any of the slots has a position or a temperature; a motor in use is never at 0 °C."""
    motors = np.frombuffer(payload, layout.LOW_STATE)["motor"][0, slots]
    return bool(motors["q"].any() or motors["temperature"].any())
