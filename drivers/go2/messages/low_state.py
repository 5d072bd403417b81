"""LowState: a Go2's state, every 2 ms."""

from __future__ import annotations

from typing import Final

from deal_hw.drivers.go2.messages.wire import ORDER
from deal_hw.drivers.unitree.go_messages import low_state
from deal_hw.drivers.unitree.go_messages.low_state import LowState, LowStateDecoder, LowStateFrame

_DECODER: Final = LowStateDecoder(ORDER)


def decode_low_state(payload: bytes, strict: bool = True) -> LowStateFrame:
    """Return the state in a LowState, joints and feet in model order (legs FL, FR, RL, RR).

    Args:
        payload: CDR with its header.
        strict: Whether to verify head and checksum, too.

    Raises:
        FrameError: Wrong length, header, head or checksum.
    """
    return _DECODER.decode(payload, strict)


def encode_low_state(state: LowState) -> bytes:
    """Return the state as CDR with header and checksum, 1180 bytes.

    Raises:
        ConfigurationError: The remote's bytes are not 40.
    """
    return low_state.encode_low_state(state, ORDER)
