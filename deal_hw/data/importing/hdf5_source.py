"""Reads an HDF5 file, and the MAT files of version 7.3, which are HDF5."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.data.importing.arrays import channels_of_arrays, unwanted
from deal_hw.data.importing.channels import Channels, digest_of_file
from deal_hw.errors import DatasetError, MissingExtraError, short
from deal_hw.reading import NAMES, NUMBERS, RECORDING_BYTES, check_size, reading

TEXT: Final = 256
"""Longest name of a joint in a MAT file [characters]."""
_MATLAB: Final = "MATLAB_class"
"""Attribute that MATLAB gives each of its variables."""
_UNITS: Final = ("units", "unit", "Units", "Unit")


def read_hdf5(path: Path) -> list[Channels]:
    """Read the arrays of numbers, (T,) or (T, K), and the joints' names.

    The names of groups become dotted names. Groups that hold the same arrays, such as demo_0 and demo_1, are
    recordings of their own. Arrays of MATLAB are turned round: it stores columns as rows. Links to other
    files are not followed.

    Raises:
        MissingExtraError: h5py is not installed.
        DatasetError: It cannot be read, or holds no arrays.
    """
    path = Path(path)
    try:
        import h5py
    except ImportError as error:
        raise MissingExtraError("h5py", "formats") from error
    with reading(path, "HDF5"):
        check_size(path, RECORDING_BYTES)
        digest = digest_of_file(path)
        if not h5py.is_hdf5(path):
            raise ValueError("it does not begin as such files do, or is cut off")
        with h5py.File(path, "r") as file:
            datasets: dict[str, Any] = {}

            def note(name: str, item: Any) -> None:
                if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                    datasets[name.replace("/", ".")] = item
                if len(datasets) > NAMES:
                    raise ValueError(f"more than {NAMES} arrays")

            file.visititems(note)
            if not datasets:
                raise DatasetError(f"{path} holds no arrays; its groups: {short(', '.join(file), 100)}")
            reader = _Reader(h5py, file)
            kind = "mat" if any(_MATLAB in item.attrs for item in datasets.values()) else "hdf5"
            found = []
            for part, arrays in _parts(datasets).items():
                values, left_out, units = reader.read(arrays)
                found.append(channels_of_arrays(path, kind, digest, values, left_out, units, part))
            return found


def _parts(datasets: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the datasets of each recording: of groups with the same datasets, or of the whole file as ""."""
    begin = ""
    while True:
        groups: dict[str, dict[str, Any]] = {}
        for name, item in datasets.items():
            group, dot, rest = name[len(begin) :].partition(".")
            if not dot:
                return {"": dict(datasets)}
            groups.setdefault(group, {})[rest] = item
        if len(groups) > 1:
            alike = len({frozenset(inside) for inside in groups.values()}) == 1
            return groups if alike else {"": dict(datasets)}
        begin += f"{next(iter(groups))}."


class _Reader:
    """Reads datasets, with one budget of numbers for all of them."""

    def __init__(self, h5py: Any, file: Any) -> None:
        self._h5py, self._file, self._left = h5py, file, NUMBERS

    def read(
        self, datasets: Mapping[str, Any]
    ) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, str], dict[str, str]]:
        """Return arrays, the omitted ones with the reason, and units."""
        found: dict[str, np.ndarray[Any, Any]] = {}
        left_out: dict[str, str] = {}
        units: dict[str, str] = {}
        for name, item in datasets.items():
            if item.external or item.is_virtual:
                left_out[name] = "its numbers are in another file"
                continue
            if (texts := self._texts(item)) is not None:
                found[name] = texts
                continue
            shape = tuple(item.shape or ())
            if why := unwanted(item.dtype, _turned(item, shape)):
                left_out[name] = why
                continue
            self._left -= math.prod(shape)
            if self._left < 0:
                raise ValueError(f"more than {NUMBERS} numbers")
            values = np.asarray(item[()])
            found[name] = (values.T if _MATLAB in item.attrs else values).reshape(_turned(item, shape))
            unit = next((item.attrs[key] for key in _UNITS if key in item.attrs), "")
            if isinstance(unit, str) and unit:
                units[name] = short(unit, 40)
        return found, left_out, units

    def _texts(self, item: Any) -> np.ndarray[Any, Any] | None:
        """Return the texts of a dataset, (N,); None if it holds none."""
        count = math.prod(item.shape or ())
        if count > NAMES:
            return None
        if self._h5py.check_string_dtype(item.dtype) is not None:
            return np.array(np.atleast_1d(item.asstr(errors="replace")[()]).ravel(), dtype=str)
        if self._h5py.check_ref_dtype(item.dtype) is None:
            return None
        # A cell array of MATLAB: each cell is a dataset of its letters.
        letters = [self._file[reference] for reference in np.ravel(item[()]) if reference]
        for one in letters:
            if not isinstance(one, self._h5py.Dataset) or one.dtype != np.uint16 or one.size > TEXT:
                return None
        return np.array(["".join(map(chr, np.ravel(one[()]))) for one in letters], dtype=str)


def _turned(item: Any, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape that MATLAB shows; a row or a column of it is one channel."""
    if _MATLAB not in item.attrs:
        return shape
    turned = shape[::-1]
    return (max(turned),) if len(turned) == 2 and 1 in turned else turned
