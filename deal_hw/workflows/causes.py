"""Why states come late or corrupt, by the wire and by this computer's load, as advice for messages.

A robot that is emulated has no cable, and a slow real one may have nothing wrong with it but a busy computer.
"""

from __future__ import annotations

from deal_hw.load import Load

LATE = frozenset(
    {"state_stale", "action_late", "command_stale", "clock_jump", "device_watchdog", "device_disarmed"}
)
"""Flags of the safety module (see `deal_hw.control.safety.safety`) that a busy computer can cause."""
BY_MOTION = frozenset({"position", "velocity", "tilt", "tumble", "flail", "motor_temperature"})
"""Flags that a gentler motion can avoid."""


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


def corrupt_advice(local: bool, load: Load, spoilt: bool = False) -> str:
    """Return the likely cause of corrupt or lost states, and what to do.

    Args:
        local: As for :func:`late_advice`.
        load: This computer's load.
        spoilt: The emulator says that it spoils frames; see
            :func:`deal_hw.robots.connect.spoilt_on_purpose`.
    """
    if spoilt:
        return (
            "the robot is an emulator that spoils frames on purpose: leave its `--corrupt`, `--drop` and "
            "`--duplicate` out, and its profile `realistic`"
        )
    if local:
        return (
            "the robot is a program on this computer (an emulator), so no cable is at fault: it or this run "
            f"was late ({load}), or another program uses its port; end other programs and run again"
        )
    return "check cable, connectors and grounding; end other programs that use the port or the bus"
