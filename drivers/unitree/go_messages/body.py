"""Body, motors, battery and remote of a LowState, in deal-hw's types."""

from __future__ import annotations

import numpy as np

from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.remote import Remote, sticks_of
from deal_hw.types import BodyState


def body_state(frame: LowStateFrame, remote: Remote | None) -> BodyState:
    """Return body, motors, battery and remote of a state.

    Args:
        frame: The state.
        remote: Its decoded remote; None if none is in reach.
    """
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
        sticks=sticks_of(remote),
        buttons=-1 if remote is None else remote.buttons,
    )
