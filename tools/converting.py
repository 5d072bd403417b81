"""What converters of public recordings share: each recording becomes one NPZ file."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.errors import DealHwError


def write_recordings(
    recordings: Sequence[Path],
    out: Path,
    arrays: Callable[[Path], Mapping[str, Any]],
    name: Callable[[Path], str] = lambda path: path.stem,
) -> bool:
    """Write an NPZ file of each recording, and print its path; say what is wrong where one cannot be read.

    Args:
        recordings: Files of the source.
        out: The folder; it is made.
        arrays: Returns the arrays of a file, by name.
        name: Returns the name of a file's NPZ file, without the suffix.

    Returns:
        Whether all were written.
    """
    out.mkdir(parents=True, exist_ok=True)
    try:
        for path in recordings:
            made = out / f"{name(path)}.npz"
            np.savez_compressed(made, **arrays(path))
            print(made)
    except DealHwError as error:
        print(f"error: {error}", file=sys.stderr)
        return False
    return True
