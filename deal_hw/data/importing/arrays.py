"""Makes channels of named arrays, as files of numbers hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats
from deal_hw.data.importing.guess import check_rows
from deal_hw.errors import short
from deal_hw.reading import NAMES

JOINT_NAMES = ("joint_names", "joints", "dof_names", "names")
"""Arrays of text that name the joints."""


def unwanted(dtype: np.dtype[Any], shape: tuple[int, ...]) -> str:
    """Return why an array of a file is no channel and no list of names; "" if it is one."""
    what = f"{short(dtype, 40)} {short(shape, 40)}"
    if dtype.kind in "US":
        return "" if len(shape) == 1 and shape[0] <= NAMES else what
    if dtype.kind == "f" and len(shape) > 2:
        return f"{what} is a batch; save each recording by itself, (T, K), such as ARRAY[0]"
    if dtype.kind not in "fiub" or len(shape) not in (1, 2) or (len(shape) == 2 and min(shape) > NAMES):
        return what
    return ""


def channels_of_arrays(
    path: Path,
    kind: str,
    digest: str,
    found: Mapping[str, np.ndarray[Any, Any]],
    left_out: Mapping[str, str],
    units: Mapping[str, str] | None = None,
    part: str = "",
) -> Channels:
    """Return the channels of the arrays of a file, which have one clock.

    Joint names are the array of text; of several, the one named as in :data:`JOINT_NAMES`. Names of arrays
    lose what all of them begin with, such as ``log.`` of a structure with everything.

    Args:
        path: The file.
        kind: Its kind.
        digest: Digest of its bytes.
        found: Arrays that :func:`unwanted` says nothing of, by dotted names.
        left_out: What was not read, and why.
        units: Units of arrays, where the file has them.
        part: Which recording of the file it is.

    Raises:
        DatasetError: The rows of an array are its columns.
    """
    texts = {name: values for name, values in found.items() if values.dtype.kind in "US"}
    # With several, such as names of actuators or bodies too, the wrong one would swap joints.
    chosen = list(texts) if len(texts) < 2 else [n for n in texts if n.rpartition(".")[2] in JOINT_NAMES][:1]
    why_not = {**left_out, **{name: "not the joints' names" for name in texts if name not in chosen}}
    numbers = {name: values for name, values in found.items() if name not in texts}
    begin = len(_common(list(numbers)))
    notes = [f"{short(name, 60)} is left out: {why}" for name, why in why_not.items()]
    notes += [_coarse(name, values) for name, values in numbers.items() if values.dtype == np.float16]
    channels = Channels(
        path=path,
        kind=kind,
        digest=digest,
        arrays={name[begin:]: as_floats(values) for name, values in numbers.items()},
        units={name[begin:]: (unit,) for name, unit in (units or {}).items() if name in numbers},
        joint_names=tuple(str(text).strip() for name in chosen for text in texts[name].astype(str)),
        part=part,
        notes=tuple(notes),
    )
    check_rows(channels)
    return channels


def _common(names: Sequence[str]) -> str:
    """Return the beginning that all dotted names share, up to a dot."""
    common = ""
    while names and all(name.startswith(common) and "." in name[len(common) :] for name in names):
        longer = names[0][: names[0].index(".", len(common)) + 1]
        if not all(name.startswith(longer) for name in names):
            break
        common = longer
    return common


def _coarse(name: str, values: np.ndarray[Any, np.dtype[np.float16]]) -> str:
    """Return the note on half-precision numbers, which have three digits."""
    most = np.max(np.abs(values[np.isfinite(values)]), initial=np.float16(0))
    return (
        f"{short(name, 60)} has half precision (float16): at {most:.4g} its values come in steps of "
        f"{np.spacing(most):.2g}. Save float64"
    )
