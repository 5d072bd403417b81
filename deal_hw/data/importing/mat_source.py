"""Reads the MAT files of MATLAB: up to version 7 by scipy, 7.3 as HDF5."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.data.importing.arrays import channels_of_arrays, unwanted
from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.data.importing.hdf5_source import read_hdf5
from deal_hw.errors import MissingExtraError
from deal_hw.reading import MIB, NUMBERS, RECORDING_BYTES, check_size, reading

_HDF5: Final = b"MATLAB 7.3"
_DEEPEST: Final = 8
_HEADER: Final = 128
"""Bytes before the first variable; the last two tell the order of bytes."""
_PACKED: Final = 15
"""Type of a variable that zlib packed."""


def read_mat(path: Path) -> list[Channels]:
    """Read the arrays of numbers and the joints' names; fields of structures get dotted names.

    A row or a column is a channel. Joint names are a cell array of texts or a matrix of letters.

    Raises:
        MissingExtraError: scipy, or for version 7.3 h5py, is not installed.
        DatasetError: It cannot be read.
    """
    path = Path(path)
    with reading(path, "MAT"):
        check_size(path, RECORDING_BYTES)
        with open(path, "rb") as file:
            start = file.read(len(_HDF5))
        if start == _HDF5:
            return read_hdf5(path)
        try:
            from scipy.io import loadmat
        except ImportError as error:
            raise MissingExtraError("scipy", "formats") from error
        _check_extent(path)
        values = loadmat(path, struct_as_record=False)
        found: dict[str, np.ndarray[Any, Any]] = {}
        left_out: dict[str, str] = {}
        for name, array in _flat({key: value for key, value in values.items() if not key.startswith("__")}):
            if why := unwanted(array.dtype, array.shape):
                left_out[name] = why
            else:
                found[name] = array
        return [channels_of_arrays(path, "mat", digest_of_file(path), found, left_out)]


def _flat(values: dict[str, Any], prefix: str = "", deepest: int = _DEEPEST) -> Iterator[tuple[str, Any]]:
    """Yield arrays by dotted name; a row, a column and a cell array of texts have one axis."""
    for name, value in values.items():
        array = np.asarray(value)
        if array.dtype == object and array.size == 1 and hasattr(array.flat[0], "_fieldnames") and deepest:
            fields = {field: getattr(array.flat[0], field) for field in array.flat[0]._fieldnames}
            yield from _flat(fields, f"{prefix}{name}.", deepest - 1)
            continue
        if array.dtype == object and all(_is_text(cell) for cell in array.flat):
            array = np.array(["".join(np.ravel(cell)) for cell in array.flat], dtype=str)
        elif array.ndim == 2 and 1 in array.shape:
            array = array.ravel()
        yield f"{prefix}{name}", array


def _is_text(cell: Any) -> bool:
    return isinstance(cell, np.ndarray) and cell.dtype.kind == "U"


def _check_extent(path: Path) -> None:
    """Check that the variables are not too large once unpacked: a file of 1 MB may hold 1 GB of zeros.

    Raises:
        ValueError: They are.
    """
    left = 8 * NUMBERS
    with open(path, "rb") as file:
        order = "<" if file.read(_HEADER)[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            if kind != _PACKED:
                file.seek(size, 1)
                continue
            unpack = zlib.decompressobj()
            data = file.read(size)
            while data:
                left -= len(unpack.decompress(data, MIB))
                data = unpack.unconsumed_tail
                if left < 0:
                    raise ValueError(f"more than {NUMBERS} numbers")
