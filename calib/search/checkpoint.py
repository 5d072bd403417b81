"""The state of a run between two generations, on disk: arrays and plain values, never pickled objects."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.errors import ConfigurationError, DatasetError, short, shown
from deal_hw.reading import RECORDING_BYTES, object_of, read_arrays, read_bytes, reading

State = Mapping[str, Any]
"""Nested mappings and lists of plain JSON values and NumPy arrays."""

_HEADER = "state"
_ARRAY = "__array__"
FORMAT = "deal_hw.checkpoint/1"


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """Return a generator's state as plain values (integers of any size and strings)."""
    return dict(rng.bit_generator.state)


def restore_generator(rng: np.random.Generator, state: State) -> None:
    """Set a generator to a saved state, so that it draws what it would have drawn.

    Raises:
        ConfigurationError: It is the state of another kind of generator.
    """
    try:
        rng.bit_generator.state = dict(state)
    except (ValueError, TypeError) as err:
        raise ConfigurationError(f"the checkpoint's generator state does not fit: {err}") from err


def pack(state: State) -> bytes:
    """Return a state as the bytes of an NPZ file: a JSON tree whose leaves name arrays beside it.

    Raises:
        TypeError: It holds something else than plain values, lists, mappings by text, and arrays of numbers.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    tree = {"format": FORMAT, "state": _plain(state, arrays)}
    header = np.frombuffer(json.dumps(tree).encode("ascii"), dtype=np.uint8)
    buffer = io.BytesIO()
    entries: dict[str, Any] = {_HEADER: header, **arrays}
    np.savez(buffer, **entries)
    return buffer.getvalue()


def _plain(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biufc":
            raise TypeError(f"a checkpoint holds arrays of numbers only, not of {value.dtype}")
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {_ARRAY: key}
    if isinstance(value, Mapping):
        if any(not isinstance(key, str) or key == _ARRAY for key in value):
            raise TypeError(f"a checkpoint's keys are text other than {_ARRAY!r}, got {list(value)}")
        return {key: _plain(v, arrays) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v, arrays) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def unpack(data: bytes) -> dict[str, Any]:
    """Return the state that :func:`pack` wrote; tuples come back as lists.

    Raises:
        DatasetError: These are not the bytes of a checkpoint.
    """
    with reading("the state", FORMAT):
        arrays, left_out = read_arrays(data, lambda dtype, shape: dtype.kind in "biufc")
        if left_out:
            raise ValueError(f"{short(next(iter(left_out)), 60)} is no array of numbers")
        header = object_of(json.loads(arrays.pop(_HEADER).tobytes()))
        if header["format"] != FORMAT:
            raise ValueError(f"format {shown(header['format'])}")
        return dict(object_of(_restored(header["state"], arrays)))


def _restored(value: Any, arrays: Mapping[str, Any]) -> Any:
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return arrays[value[_ARRAY]]
        return {k: _restored(v, arrays) for k, v in value.items()}
    if isinstance(value, list):
        return [_restored(v, arrays) for v in value]
    return value


class Checkpoint:
    """A checkpoint file of one run; written whole or not at all. A :class:`deal_hw.calibration.StateStore`.

    Args:
        path: The file.
        identity: Digest of everything that decides the run's numbers; a file of another run is refused.
        fresh: Begin anew: a file that is there is not read, and is replaced by the first state.
    """

    def __init__(self, path: Path, identity: str, *, fresh: bool = False) -> None:
        self.path = path
        self.identity = identity
        self._fresh = fresh

    def save(self, state: State) -> None:
        """Replace the file by this state.

        Raises:
            DatasetError: The file cannot be written.
        """
        waiting = self.path.with_suffix(".part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            waiting.write_bytes(pack({"identity": self.identity, "run": state}))
            os.replace(waiting, self.path)
            self._fresh = False
        except OSError as err:
            raise DatasetError(f"{self.path} cannot be written: {err.strerror}") from err

    def load(self) -> dict[str, Any] | None:
        """Return the saved state, or None where there is none to continue.

        Raises:
            ConfigurationError: The file belongs to another run.
            DatasetError: The file is unreadable.
        """
        if self._fresh:
            return None
        if not self.path.exists():
            return None
        with reading(self.path, "a calibration's state", "remove it and begin again"):
            saved = unpack(read_bytes(self.path, RECORDING_BYTES))
        if saved.get("identity") != self.identity:
            raise ConfigurationError(
                f"{self.path} is of a run with other data, settings or versions and cannot be resumed; "
                "remove it, or repeat the settings of that run"
            )
        with reading(self.path, "a calibration's state", "remove it and begin again"):
            return dict(object_of(saved["run"]))

    def remove(self) -> None:
        """Remove the file: the run is over."""
        for path in (self.path, self.path.with_suffix(".part")):
            path.unlink(missing_ok=True)
