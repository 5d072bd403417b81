"""The Go2's low-level messages: bytes <-> values in SI units and model order.

Only the wire knows the order FR, FL, RR, RL of legs and joints; names join it to the model's. Payloads are
whole CDR messages with their 4-byte header, as DDS and Zenoh carry them.

A hazard of this wire: LowCmd has 812 bytes and LowState 1180, as CDR with header and also as the C struct of
the vendor's checksum. The two layouts differ. A C struct given as CDR is refused by its missing header.
"""

from __future__ import annotations

from deal_hw.drivers.go2.messages.layout import LOW_COMMAND_BYTES, LOW_STATE_BYTES
from deal_hw.drivers.go2.messages.low_command import (
    MODE_OFF,
    MODE_SERVO,
    POSITION_STOP,
    VELOCITY_STOP,
    LowCommand,
    LowCommandEncoder,
    decode_low_command,
)
from deal_hw.drivers.go2.messages.low_state import LowState, LowStateFrame, decode_low_state, encode_low_state
from deal_hw.drivers.go2.messages.wire import CDR_HEADER, HEAD, LEVEL_LOW, WIRE_JOINTS, WIRE_LEGS

__all__ = [
    "CDR_HEADER",
    "HEAD",
    "LEVEL_LOW",
    "LOW_COMMAND_BYTES",
    "LOW_STATE_BYTES",
    "MODE_OFF",
    "MODE_SERVO",
    "POSITION_STOP",
    "VELOCITY_STOP",
    "WIRE_JOINTS",
    "WIRE_LEGS",
    "LowCommand",
    "LowCommandEncoder",
    "LowState",
    "LowStateFrame",
    "decode_low_command",
    "decode_low_state",
    "encode_low_state",
]
