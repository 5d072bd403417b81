"""Common parts of unitree_go's two low-level messages: header, checksum, and checks of frames."""

from __future__ import annotations

import functools
from typing import Final

import numpy as np
import numpy.typing as npt

from deal_hw.drivers.unitree.cdr import CDR_HEADER, check_length, field_mask, masked, verify_words
from deal_hw.drivers.unitree.go_messages import layout
from deal_hw.drivers.unitree.go_messages.layout import LOW_COMMAND_BYTES, LOW_STATE_BYTES
from deal_hw.errors import FrameError

HEAD: Final = b"\xfe\xef"
BEGIN: Final = CDR_HEADER + HEAD
LEVEL_LOW: Final = 0xFF
"""level_flag of commands to the motors themselves (0xEE: to the vendor's gaits)."""


def low_command_image(payload: bytes) -> bytes:
    """Return the C struct's image of a LowCmd without its last word, 808 bytes.

    Args:
        payload: CDR with its header, 812 bytes.
    """
    return payload[4:26] + b"\0\0" + payload[26:27] + b"\0\0\0" + payload[28:808]


def low_state_image(payload: bytes) -> bytes:
    """Return the C struct's image of a LowState without its last word, 1176 bytes.

    Args:
        payload: CDR with its header, 1180 bytes.
    """
    return payload[4:81] + b"\0\0\0" + payload[81:82] + b"\0\0\0" + payload[84:1176]


def check_frame(payload: bytes, name: str, *, head: bool = True) -> None:
    """Refuse a payload that is not a whole CDR message of this type.

    Args:
        payload: The received bytes.
        name: "LowCmd" or "LowState".
        head: Whether to check the message's own head, too.

    Raises:
        FrameError: Wrong length, header or head; the message names it.
    """
    size = LOW_COMMAND_BYTES if name == "LowCmd" else LOW_STATE_BYTES
    check_length(payload, name, size)
    if payload[:2] == HEAD:
        raise FrameError(
            f"{name}: {size} bytes that begin with FE EF are the C struct's image, which has another layout "
            f"than CDR of the same length; send CDR, which begins with {CDR_HEADER.hex(' ')}"
        )
    if payload[:4] != CDR_HEADER:
        raise FrameError(
            f"{name}: the CDR header is {payload[:4].hex(' ')}, expected {CDR_HEADER.hex(' ')} "
            "(version 1, little-endian)"
        )
    if head and payload[4:6] != HEAD:
        raise FrameError(f"{name}: the head is {payload[4:6].hex(' ')}, expected {HEAD.hex(' ')}")


def verify_crc(payload: bytes, name: str) -> None:
    """Refuse a message whose checksum is wrong.

    Args:
        payload: Of the right length.
        name: "LowCmd" or "LowState".

    Raises:
        FrameError: It is wrong.
    """
    image = low_command_image if name == "LowCmd" else low_state_image
    verify_words(payload, name, image, _padding_mask)


def without_padding(payload: bytes, name: str) -> bytes:
    """Return a "LowCmd" or "LowState" of the right length with zeros between its fields."""
    return masked(payload, _padding_mask(name))


@functools.cache
def _padding_mask(name: str) -> npt.NDArray[np.uint8]:
    """Return 255 for each byte that belongs to a field, 0 for padding."""
    kind, modes = (
        (layout.LOW_COMMAND, layout.COMMAND_MODE_AT)
        if name == "LowCmd"
        else (layout.LOW_STATE, layout.STATE_MODE_AT)
    )
    return field_mask(kind, modes, layout.SLOTS)
