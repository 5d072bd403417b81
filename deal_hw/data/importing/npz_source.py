"""Reads a NumPy archive; nothing in it is ever executed."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats, digest_of_file
from deal_hw.errors import DatasetError
from deal_hw.types import FloatArray


def read_npz(path: Path) -> Channels:
    """Read the arrays of numbers, (T,) or (T, K), and the joint names of an NPZ file.

    Joint names are a one-dimensional array of text. Arrays of other shapes or kinds are left out with a note;
    so are pickled objects, which could run anything.

    Raises:
        DatasetError: It cannot be read.
    """
    path = Path(path)
    digest = digest_of_file(path)
    arrays: dict[str, FloatArray] = {}
    joint_names: tuple[str, ...] = ()
    notes: list[str] = []
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            raise DatasetError(f"{path} holds one unnamed array; save it with numpy.savez(path, time=...)")
        with loaded as archive:
            for name in archive.files:
                try:
                    values = archive[name]
                except ValueError as error:  # A pickled object.
                    notes.append(f"{name} is left out ({error})")
                    continue
                if values.dtype.kind in "US" and values.ndim == 1:
                    joint_names = tuple(str(text) for text in values.astype(str))
                elif values.dtype.kind in "fiub" and values.ndim in (1, 2):
                    arrays[name] = as_floats(values)
                else:
                    notes.append(f"{name} is left out: {values.dtype} {values.shape}")
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path} cannot be read as NPZ: {error}") from error
    return Channels(
        path=path, kind="npz", digest=digest, arrays=arrays, joint_names=joint_names, notes=tuple(notes)
    )
