"""Body, motors, battery and remote of a LowState, in deal-hw's types."""

from __future__ import annotations

from typing import Final

import numpy as np

from deal_hw.drivers.go2.messages.low_state import LowStateFrame
from deal_hw.drivers.go2.messages.remote import Remote
from deal_hw.types import BodyState, FloatArray

DAMPED_TOLERANCE_NM: Final = 1.5
DAMPED_TOLERANCE_SHARE: Final = 0.3
"""Largest difference of estimated efforts from damping: the motors' noise, and the change of a joint's speed
within a sample."""


def body_state(frame: LowStateFrame, remote: Remote | None) -> BodyState:
    """Return body, motors, battery and remote of a state.

    Args:
        frame: The state.
        remote: Its decoded remote; None if none is in reach.
    """
    sticks = np.zeros(4)
    if remote is not None:
        sticks[:] = remote.left_x, remote.left_y, remote.right_x, remote.right_y
    return BodyState(
        orientation=frame.orientation,
        angular_velocity=frame.angular_velocity,
        acceleration=frame.specific_force,
        foot_force=frame.foot_force.astype(np.float64),
        temperature=frame.temperature.astype(np.float64),
        lost=frame.lost,
        battery=frame.battery_percent / 100,
        voltage=frame.voltage,
        current=frame.current,
        sticks=sticks,
        buttons=-1 if remote is None else remote.buttons,
    )


def is_damped(frame: LowStateFrame, damping: FloatArray, effort_limit: FloatArray) -> bool:
    """Return whether the motors' estimated efforts are those of pure damping.

    A joint whose sensor gives no number is left out, unless none gives one.

    Args:
        frame: The state.
        damping: kd of each joint, (J,) [N·m·s/rad].
        effort_limit: Largest effort of each motor, (J,) [N·m].
    """
    braking = np.clip(-damping * frame.velocity, -effort_limit, effort_limit)
    allowed = DAMPED_TOLERANCE_NM + DAMPED_TOLERANCE_SHARE * np.abs(braking)
    excess = np.abs(frame.effort - braking) - allowed
    known = excess[np.isfinite(excess)]
    return known.size > 0 and bool((known <= 0.0).all())
