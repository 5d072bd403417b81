"""Why states come late or corrupt, by the wire and by this computer's load, as advice for messages.

A robot that is emulated has no cable, and a slow real one may have nothing wrong with it but a busy computer.
"""

from __future__ import annotations

from deal_hw.load import Load

LATE = frozenset(
    {"state_stale", "action_late", "command_stale", "clock_jump", "device_watchdog", "device_disarmed"}
)
"""Flags of the safety module (see `deal_hw.control.safety.safety`) that a busy computer can cause."""


def late_advice(local: bool, load: Load) -> str:
    """Return the likely cause of late states or commands, and what to do.

    Args:
        local: The robot is a program on this computer; see :func:`deal_hw.drivers.on_this_computer`.
        load: This computer's load.
    """
    if local:
        return (
            f"{load}; the robot is a program on this computer (an emulator), so no cable is at fault: it "
            "or the control loop was late; end other programs and run again"
        )
    if load.high:
        return f"{load}: this computer is busy; end other programs and run again, then check the cable"
    return f"{load}, which is no cause; check cable, connectors and wireless"


def corrupt_advice(local: bool, load: Load) -> str:
    """Return the likely cause of corrupt or lost states, and what to do; arguments as :func:`late_advice`."""
    if local:
        return (
            "the robot is a program on this computer (an emulator), so no cable is at fault: it spoils "
            "frames on purpose (`emulate --profile realistic`, `--corrupt`, `--drop`), or it was late "
            f"({load})"
        )
    return "check cable, connectors and grounding"
