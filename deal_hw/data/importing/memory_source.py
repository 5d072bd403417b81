"""Reads a recording in memory: arrays by name, or a data frame."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.data.importing.channels import Channels, as_floats
from deal_hw.data.importing.guess import check_rows
from deal_hw.errors import DatasetError, short
from deal_hw.types import FloatArray

JOINTS = "joints"
"""Key of the joints' names among the arrays."""


def read_memory(values: Any, name: str) -> Channels:
    """Take arrays of numbers, (T,) or (T, K), by name, or the columns of a data frame.

    ``{"time": t, "position": q, "target": u}`` with one column per joint, or one channel per joint as in a
    CSV file: ``{"time": t, "elbow_pos": q0, "elbow_cmd": u0}``. An entry ``"joints"`` names the columns;
    without it they are in the model's order.

    Args:
        values: The mapping or data frame.
        name: Its name in messages.

    Raises:
        DatasetError: It is of another type, or an entry is no array of numbers.
    """
    if not isinstance(values, Mapping) and not hasattr(values, "columns"):
        raise DatasetError(
            f"{name} is of type {type(values).__name__}; a recording is a file's path, a mapping of names to "
            'arrays such as {"time": t, "position": q, "target": u}, or a data frame with such columns'
        )
    keys = list(values) if isinstance(values, Mapping) else list(values.columns)
    names = tuple(str(joint) for joint in values[JOINTS]) if JOINTS in keys else ()
    arrays = {str(key): _channel(values[key], f"{name}[{key!r}]") for key in keys if key != JOINTS}
    if not arrays:
        raise DatasetError(f"{name} is empty; a recording has time, positions and commands")
    digest = hashlib.sha256()
    for key, array in arrays.items():
        digest.update(key.encode())
        digest.update(array.tobytes())
    channels = Channels(Path(name), "arrays", digest.hexdigest(), arrays, joint_names=names)
    check_rows(channels)
    return channels


def _channel(values: Any, name: str) -> FloatArray:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise DatasetError(f"{name} is no array: {short(str(error), 80)}") from error
    if array.dtype.kind not in "fiub" or array.ndim not in (1, 2):
        raise DatasetError(
            f"{name} has shape {array.shape} and type {array.dtype}; allowed are numbers, (T,) or (T, K)"
        )
    return as_floats(array)
