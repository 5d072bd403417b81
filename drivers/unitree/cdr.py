"""CDR header, layouts and checksum of Unitree's low-level messages.

The checksum is CRC-32/MPEG-2: polynomial 0x04C11DB7, start 0xFFFFFFFF, no reflection, no final inversion. It
covers the 32-bit words of the C struct without the last one, the checksum itself. Each word is a
little-endian number, most significant bit first. The C struct aligns nested structs, CDR does not, so the
struct's image is the CDR body with a few more bytes of padding. Source: crc32_core of unitree_sdk2_python @
37116c5.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from fastcrc import crc32

from deal_hw.errors import FrameError

CDR_HEADER: Final = b"\x00\x01\x00\x00"
"""CDR version 1, little-endian."""
CRC_START: Final = 0xFFFF_FFFF


def words_crc(image: bytes | bytearray, start: int = CRC_START) -> int:
    """Return the checksum of whole 32-bit words, continued from ``start``."""
    words = array("I", image)
    words.byteswap()
    return int(crc32.mpeg_2(words, start))


def check_length(payload: bytes, name: str, size: int) -> None:
    """Refuse a message of another length.

    Raises:
        FrameError: It has another; without the CDR header, the message says so.
    """
    if len(payload) != size:
        hint = ": the CDR header is missing" if len(payload) == size - len(CDR_HEADER) else ""
        raise FrameError(f"{name}: {len(payload)} bytes, expected {size} with the CDR header{hint}")


def masked(payload: bytes, mask: npt.NDArray[np.uint8]) -> bytes:
    """Return a message with zeros where its mask has them."""
    return (np.frombuffer(payload, "u1") & mask).tobytes()


def verify_words(
    payload: bytes,
    name: str,
    image: Callable[[bytes], bytes],
    mask: Callable[[str], npt.NDArray[np.uint8]],
) -> None:
    """Refuse a message whose checksum, its last word, is wrong.

    Args:
        payload: Of the right length.
        name: The message.
        image: Returns the C struct's image of a payload, without its last word.
        mask: Returns the message's :func:`field_mask`.

    Raises:
        FrameError: It is wrong.
    """
    given = int.from_bytes(payload[-4:], "little")
    if words_crc(image(payload)) == given:
        return
    # Padding has no meaning, and the sender computes the checksum with 0 there.
    found = words_crc(image(masked(payload, mask(name))))
    if found != given:
        raise FrameError(f"{name}: the checksum is 0x{given:08X}, expected 0x{found:08X}: corrupt on the way")


def packed(size: int, fields: Mapping[str, tuple[Any, int]]) -> np.dtype[np.void]:
    """Return the layout of a message of this length; each field has its kind and its first byte."""
    return np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": size,
        }
    )


def field_mask(kind: np.dtype[np.void], modes: npt.NDArray[np.int64], slots: int) -> npt.NDArray[np.uint8]:
    """Return 255 for each byte that belongs to a field, 0 for padding.

    Args:
        kind: The layout, with motors as an array of structs.
        modes: Offsets of the motors' mode bytes, which are not among the layout's fields.
        slots: Number of motors.
    """
    mask = np.zeros(kind.itemsize, np.uint8)
    fields: Mapping[str, Any] = kind.fields or {}
    for field_type, offset, *_ in fields.values():
        if field_type.subdtype is not None and field_type.base.fields:
            for part, at, *_ in field_type.base.fields.values():
                for slot in range(slots):
                    begin = offset + slot * field_type.base.itemsize + at
                    mask[begin : begin + part.itemsize] = 255
        else:
            mask[offset : offset + field_type.itemsize] = 255
    mask[modes] = 255
    return mask
