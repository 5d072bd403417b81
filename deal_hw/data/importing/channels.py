"""Named channels of a file, not yet interpreted."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from deal_hw.data.files import sha256_of
from deal_hw.errors import DatasetError, short
from deal_hw.types import FloatArray

_PICK = re.compile(r"(?P<array>.+)\[(?P<inside>[^\[\]]+)\]")


@dataclass(frozen=True, slots=True, eq=False)
class Channels:
    """Channels of one recording, by the file's names.

    Attributes:
        path: The file or folder.
        kind: Of file, such as "csv", "npz", "mcap", "lerobot" or "deal-hw".
        digest: SHA-256 of the read bytes.
        arrays: By name, (T,) or (T, K); those of one clock have one length.
        labels: Names of the K columns of an array, if the file has them.
        units: Units of the K columns of an array, if the file has them.
        types: Message type of each topic of a bag, such as "sensor_msgs/msg/JointState".
        joint_names: Names of the joints, if the file lists them.
        part: Which recording of the file it is, such as "episode 3"; "" if there is only one.
        notes: Changes and omissions by the reader.
    """

    path: Path
    kind: str
    digest: str
    arrays: Mapping[str, FloatArray]
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    types: Mapping[str, str] = field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    part: str = ""
    notes: tuple[str, ...] = ()

    def listed(self) -> str:
        """Return the names of the channels for a message, with the number of columns of an array."""
        names = [
            name if values.ndim == 1 else f"{name}[{values.shape[1]}]" for name, values in self.arrays.items()
        ]
        return ", ".join([*names[:24], *(["..."] if len(names) > 24 else [])]) or "none"

    def is_wide(self, name: str) -> bool:
        """Return whether there is an array of this name with several columns."""
        return name in self.arrays and self.arrays[name].ndim == 2

    def width(self, name: str) -> int:
        """Return the number of columns of an array; 1 for a channel without any."""
        values = self.arrays[name]
        return 1 if values.ndim == 1 else values.shape[1]

    def column(self, name: str) -> FloatArray:
        """Return one channel, (T,).

        Args:
            name: An array, or a column of one: ``dof_pos[3]``, ``/joint_states.position[elbow]``.

        Raises:
            DatasetError: There is no such channel, or it has several columns.
        """
        values = self.array(name)
        if values.ndim == 1:
            return values
        if values.shape[1] == 1:
            return values[:, 0]
        raise DatasetError(
            f"{self.path}: {name!r} has {values.shape[1]} columns; name one of them, such as {name}[0]"
        )

    def array(self, name: str) -> FloatArray:
        """Return an array or one of its columns, (T,) or (T, K); errors as :meth:`column`."""
        if name in self.arrays:
            return self.arrays[name]
        picked = _PICK.fullmatch(name)
        if picked and picked["array"] in self.arrays:
            return self._inside(picked["array"], picked["inside"])
        near = difflib.get_close_matches(name, self.arrays, n=3) or list(self.arrays)[:12]
        raise DatasetError(
            f"{self.path} has no channel {short(name)!r} ({len(self.arrays)} channels; near it: "
            f"{short(', '.join(near)) or 'none'}); correct the column map"
        )

    def _inside(self, array: str, inside: str) -> FloatArray:
        values = self.arrays[array]
        width = 1 if values.ndim == 1 else values.shape[1]
        labels = self.labels.get(array, ())
        if inside in labels:
            index = labels.index(inside)
        elif inside.isdecimal() and len(inside) < 10 and int(inside) < width:
            index = int(inside)
        else:
            names = f", named {short(', '.join(labels))}" if labels else ""
            raise DatasetError(
                f"{self.path}: {short(array)!r} has no column {short(inside)!r}; it has {width}, from 0"
                f"{names}"
            )
        return values if values.ndim == 1 else values[:, index]


def digest_of_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes.

    Raises:
        DatasetError: It cannot be read.
    """
    try:
        return sha256_of(path).hexdigest()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from error


def digest_of_files(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of a file, or that of the digests of several; errors as :func:`digest_of_file`."""
    if len(paths) == 1:
        return digest_of_file(paths[0])
    return hashlib.sha256("".join(map(digest_of_file, paths)).encode()).hexdigest()


def as_floats(values: object) -> FloatArray:
    """Return an array as float64, contiguous."""
    return np.ascontiguousarray(values, dtype=np.float64)
