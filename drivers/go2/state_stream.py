"""Selects the valid and new LowStates of a Go2."""

from __future__ import annotations

from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.go2.messages.refusals import Refusals, StateCheck, is_strict
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.drivers.unitree.tick_stream import TickStream


class StateStream(TickStream[LowStateFrame]):
    """The same of a Go2's states.

    Args:
        check: What a state must pass.
        refusals: Counts refused states, and names the robot.

    Raises:
        UnknownNameError: There is no such check.
    """

    def __init__(self, check: StateCheck = "strict", refusals: type[Refusals] = Refusals) -> None:
        strict = is_strict(check, "Go2")
        super().__init__(refusals.robot[0], lambda payload: decode_low_state(payload, strict), refusals)
