"""Reads a NumPy archive; nothing in it is ever executed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats, digest_of_file, unwanted
from deal_hw.data.importing.guess import check_rows
from deal_hw.errors import DatasetError, short
from deal_hw.reading import RECORDING_BYTES, check_size, read_arrays, reading

JOINT_NAMES = ("joint_names", "joints", "dof_names", "names")
"""Arrays of text that name the joints."""


def read_npz(path: Path) -> Channels:
    """Read the arrays of numbers, (T,) or (T, K), and the joint names of an NPZ file.

    Joint names are the one-dimensional array of text; of several, the one named as in :data:`JOINT_NAMES`.
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
        texts = {name: values for name, values in found.items() if values.dtype.kind in "US"}
        arrays = {name: as_floats(values) for name, values in found.items() if name not in texts}
        # With several, such as names of actuators or bodies too, the wrong one would swap joints.
        chosen = list(texts) if len(texts) < 2 else [name for name in JOINT_NAMES if name in texts][:1]
        joint_names = tuple(str(text) for name in chosen for text in texts[name].astype(str))
        left_out |= {name: "not the joints' names" for name in texts if name not in chosen}
    notes = (
        *(f"{short(name, 60)} is left out: {why}" for name, why in left_out.items()),
        *(_coarse(name, values) for name, values in found.items() if values.dtype == np.float16),
    )
    channels = Channels(
        path=path, kind="npz", digest=digest, arrays=arrays, joint_names=joint_names, notes=notes
    )
    check_rows(channels)
    return channels


def _coarse(name: str, values: np.ndarray[Any, np.dtype[np.float16]]) -> str:
    """Return the note on half-precision numbers, which have three digits."""
    most = np.max(np.abs(values[np.isfinite(values)]), initial=np.float16(0))
    return (
        f"{short(name, 60)} has half precision (float16): at {most:.4g} its values come in steps of "
        f"{np.spacing(most):.2g}. Save float64"
    )
