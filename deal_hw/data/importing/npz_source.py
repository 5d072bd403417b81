"""Reads a NumPy archive; nothing in it is ever executed."""

from __future__ import annotations

from pathlib import Path

from deal_hw.data.importing.arrays import channels_of_arrays, unwanted
from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.errors import DatasetError
from deal_hw.reading import RECORDING_BYTES, check_size, read_arrays, reading


def read_npz(path: Path) -> Channels:
    """Read the arrays of numbers, (T,) or (T, K), and the joint names of an NPZ file.

    Arrays of other shapes or kinds are left out with a note, and so are pickled objects, which could run
    anything. Sizes are limited, see :mod:`deal_hw.reading`.

    Raises:
        DatasetError: It cannot be read, or an array's rows are its joints.
    """
    path = Path(path)
    with reading(path, "NPZ", "save it with numpy.savez(path, time=..., position=...)"):
        check_size(path, RECORDING_BYTES)
        digest = digest_of_file(path)
        with open(path, "rb") as file:
            if file.read(6) == b"\x93NUMPY":
                raise DatasetError(
                    f"{path} holds one unnamed array; save it with numpy.savez(path, time=...)"
                )
        found, left_out = read_arrays(path, unwanted)
        return channels_of_arrays(path, "npz", digest, found, left_out)
