"""The passive command, sent until the robot confirms it: the last thing that any run does."""

from __future__ import annotations

import contextlib

from deal_hw.clock import Clock
from deal_hw.errors import TransportTimeoutError
from deal_hw.robot import Robot
from deal_hw.types import Status

ATTEMPTS = 10
"""Half a second in all: legs that were moving swing out before a robot can show that they are damped."""
CONFIRM_S = 0.05


def make_passive(robot: Robot, clock: Clock, attempts: int = ATTEMPTS, confirm_s: float = CONFIRM_S) -> bool:
    """Send the passive command until the robot reports that its motors no longer follow commands.

    Never raises: whoever calls it has something worse at hand.

    Args:
        robot: Connected, or at least with an open port.
        clock: For the waiting.
        attempts: How often to send it.
        confirm_s: How long to wait for the confirmation of each [s].

    Returns:
        Whether the robot confirmed it.
    """
    for _ in range(attempts):
        try:
            # A sample that waited since before the run also says "not armed": only what comes now counts. A
            # path that cannot be read may still be written.
            with contextlib.suppress(Exception):
                _drain(robot)
            robot.passive()
            if _confirmed(robot, clock, confirm_s):
                return True
        except Exception:  # Even a bug in a driver must not keep the next attempt from being made.
            continue
    return False


def _drain(robot: Robot) -> None:
    try:
        while True:
            robot.read_state(0.0)
    except TransportTimeoutError:
        return


def _confirmed(robot: Robot, clock: Clock, confirm_s: float) -> bool:
    until_ns = clock.now_ns() + round(confirm_s * 1e9)
    while (left_ns := until_ns - clock.now_ns()) > 0:
        try:
            if Status.ARMED not in robot.read_state(left_ns * 1e-9).status:
                return True
        except TransportTimeoutError:
            return False
    return False
