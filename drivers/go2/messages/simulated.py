"""States of the vendor's simulator unitree_mujoco: recognition and messages."""

from __future__ import annotations

from typing import Final, Literal

from deal_hw.drivers.go2.messages.low_state import decode_low_state
from deal_hw.drivers.transports import topics
from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.drivers.unitree.go_messages.frames import HEAD
from deal_hw.drivers.unitree.go_messages.layout import LOW_STATE_BYTES
from deal_hw.drivers.unitree.go_messages.low_state import LowStateFrame
from deal_hw.errors import FrameError, VersionMismatchError

Simulator = Literal["none", "unitree_mujoco"]
"""Name of the simulator."""
UNITREE_MUJOCO: Final = (
    "no head, no battery: the simulator unitree_mujoco sends such states. If it runs there, add "
    "`--simulator unitree_mujoco`, which says what replaces the checks that its states do not allow. "
    "A real Go2 never sends them: if it is one, do not command it"
)
_HEADLESS: Final = slice(4, 6)
_BATTERY: Final = slice(1040, 1084)
_SUPPLY: Final = slice(1156, 1164)
"""Bytes of a LowState that unitree_mujoco leaves 0: head; battery; voltage and current of the supply."""
NOTICE: Final = (
    "note: the robot is the simulator unitree_mujoco. Its states have no head, clock, checksum and battery, "
    "and it has no motion switcher. So a state counts as new if it differs from the one before; its age is "
    "that of its reception. Battery and sport mode are not checked. All other limits are the Go2's. It holds "
    "the torques of the last command for ever. At the end damping is sent until the joints are slow. If "
    "deal-hw is killed (kill -9), nothing damps it"
)


def is_unitree_mujoco(payload: bytes) -> bool:
    """Return whether a LowState has neither head nor battery, as those of unitree_mujoco."""
    return (
        len(payload) == LOW_STATE_BYTES
        and payload[:4] == CDR_HEADER
        and not any(payload[_HEADLESS] + payload[_BATTERY] + payload[_SUPPLY])
    )


def decode_simulated(payload: bytes) -> LowStateFrame:
    """Return the state in a LowState of unitree_mujoco.

    Raises:
        FrameError: Wrong length or header, or a field is set that the simulator leaves 0.
        VersionMismatchError: It has a head, as a real Go2's.
    """
    frame = decode_low_state(payload, strict=False)
    if payload[4:6] == HEAD:
        raise VersionMismatchError(
            f"go2: a state on {topics.LOW_STATE} has a head (fe ef), and unitree_mujoco sends none: this is "
            "a real Go2, or deal-hw's emulator. Leave `--simulator` out. If it is a newer unitree_mujoco, "
            "update deal-hw"
        )
    if not is_unitree_mujoco(payload):
        raise FrameError("LowState: head or battery are set, and unitree_mujoco leaves both 0")
    return frame
