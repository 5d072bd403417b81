"""The remote control of Unitree's robots: the 40 bytes in each LowState, and the message WirelessController.

Layout of the 40 bytes, from unitree_sdk2_python @ 37116c5: two bytes of head, buttons as 16 bits, then the
sticks as floats: lx at 4, rx at 8, ry at 12, ly at 20 (L2's travel at 16). All zeros: no remote in reach.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.drivers.unitree.cdr import CDR_HEADER
from deal_hw.errors import ConfigurationError, FrameError, UnknownNameError
from deal_hw.types import FloatArray

BUTTONS: Final = (
    "R1",
    "L1",
    "start",
    "select",
    "R2",
    "L2",
    "F1",
    "F2",
    "A",
    "B",
    "X",
    "Y",
    "up",
    "right",
    "down",
    "left",
)
"""Bit 0 first."""
REMOTE_BYTES: Final = 40
_REMOTE: Final = struct.Struct("<2sH5f16x")
_HEAD: Final = b"\x55\x51"
_WIRELESS: Final = struct.Struct("<4s4fH")
WIRELESS_BYTES: Final = _WIRELESS.size


@dataclass(frozen=True, slots=True)
class Remote:
    """State of the remote.

    Attributes:
        buttons: A bit each, as :data:`BUTTONS`.
        left_x: Left stick, -1 left to 1 right.
        left_y: Left stick, -1 down to 1 up.
        right_x: Right stick.
        right_y: Right stick.
    """

    buttons: int = 0
    left_x: float = 0.0
    left_y: float = 0.0
    right_x: float = 0.0
    right_y: float = 0.0

    def holds(self, mask: int) -> bool:
        """Return whether all buttons of a mask are held; an empty mask is never held."""
        return mask != 0 and self.buttons & mask == mask


def sticks_of(remote: Remote | None) -> FloatArray:
    """Return left x and y, right x and y, (4,); zeros for none in reach."""
    if remote is None:
        return np.zeros(4)
    return np.array((remote.left_x, remote.left_y, remote.right_x, remote.right_y))


def button_mask(names: Iterable[str]) -> int:
    """Return the bits of some buttons.

    Raises:
        UnknownNameError: There is no such button.
    """
    mask = 0
    for name in names:
        if name not in BUTTONS:
            raise UnknownNameError("button", name, BUTTONS)
        mask |= 1 << BUTTONS.index(name)
    return mask


def parse_combination(text: str) -> int:
    """Return the bits of a combination such as ``"L2+B"``; 0 for the empty text.

    Raises:
        UnknownNameError: There is no such button.
    """
    return button_mask(text.split("+")) if text else 0


def decode_remote(data: bytes) -> Remote | None:
    """Return the remote in a LowState's 40 bytes; None if no remote is in reach.

    Raises:
        FrameError: Not 40 bytes.
    """
    if len(data) != REMOTE_BYTES:
        raise FrameError(f"wireless_remote has {len(data)} bytes, expected {REMOTE_BYTES}")
    if data.count(0) == REMOTE_BYTES:
        return None
    _, buttons, left_x, right_x, right_y, _, left_y = _REMOTE.unpack(data)
    return Remote(buttons, left_x, left_y, right_x, right_y)


def encode_remote(remote: Remote | None) -> bytes:
    """Return a LowState's 40 bytes for a remote; zeros for none.

    Raises:
        ConfigurationError: The buttons are no 16 bits.
    """
    if remote is None:
        return bytes(REMOTE_BYTES)
    _check_buttons(remote.buttons)
    pulled = 1.0 if remote.holds(button_mask(["L2"])) else 0.0
    return _REMOTE.pack(
        _HEAD, remote.buttons, remote.left_x, remote.right_x, remote.right_y, pulled, remote.left_y
    )


def decode_wireless(payload: bytes) -> Remote:
    """Return the remote in a WirelessController message.

    Raises:
        FrameError: Wrong length or header.
    """
    # CDR may be padded to whole words.
    if len(payload) not in (WIRELESS_BYTES, WIRELESS_BYTES + 2) or payload[:3] != CDR_HEADER[:3]:
        raise FrameError(
            f"WirelessController: {len(payload)} bytes that begin with {payload[:4].hex(' ') or 'nothing'}, "
            f"expected {WIRELESS_BYTES} that begin with {CDR_HEADER.hex(' ')}"
        )
    _, left_x, left_y, right_x, right_y, buttons = _WIRELESS.unpack_from(payload)
    return Remote(buttons, left_x, left_y, right_x, right_y)


def encode_wireless(remote: Remote) -> bytes:
    """Return a remote as a WirelessController message.

    Raises:
        ConfigurationError: The buttons are no 16 bits.
    """
    _check_buttons(remote.buttons)
    return _WIRELESS.pack(
        CDR_HEADER, remote.left_x, remote.left_y, remote.right_x, remote.right_y, remote.buttons
    )


def _check_buttons(buttons: int) -> None:
    if not 0 <= buttons <= 0xFFFF:
        raise ConfigurationError(f"buttons 0x{buttons:X}: 16 bits, 0 to 0xFFFF")
