"""The state of a run between two generations, on disk: arrays and plain values, never pickled objects."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deal_hw.errors import ConfigurationError, DatasetError

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
    """Return a state as the bytes of an NPZ file: a JSON tree whose leaves name arrays beside it."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if value.dtype.hasobject:
                raise TypeError("a checkpoint holds arrays of numbers only")
            key = f"a{len(arrays)}"
            arrays[key] = value
            return {_ARRAY: key}
        if isinstance(value, Mapping):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [plain(v) for v in value]
        if isinstance(value, np.generic):
            return value.item()
        return value

    header = json.dumps({"format": FORMAT, "state": plain(state)})
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{_HEADER: np.array(header), **arrays})
    return buffer.getvalue()


def unpack(data: bytes) -> dict[str, Any]:
    """Return the state that :func:`pack` wrote; tuples come back as lists.

    Raises:
        DatasetError: These are not the bytes of a checkpoint.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            header = json.loads(str(file[_HEADER]))
            arrays = {key: file[key] for key in file.files if key != _HEADER}
        if header["format"] != FORMAT:
            raise ValueError(f"format {header['format']!r}")
        state: dict[str, Any] = _restored(header["state"], arrays)
    except (OSError, ValueError, KeyError, TypeError, EOFError) as err:
        raise DatasetError(f"this is no checkpoint of {FORMAT}: {err}") from err
    return state


def _restored(value: Any, arrays: Mapping[str, Any]) -> Any:
    if isinstance(value, dict):
        if set(value) == {_ARRAY}:
            return arrays[value[_ARRAY]]
        return {k: _restored(v, arrays) for k, v in value.items()}
    if isinstance(value, list):
        return [_restored(v, arrays) for v in value]
    return value


class Checkpoint:
    """A checkpoint file of one run; written whole or not at all.

    Args:
        path: The file.
        identity: Digest of everything that decides the run's numbers; a file of another run is refused.
    """

    def __init__(self, path: Path, identity: str) -> None:
        self.path = path
        self.identity = identity

    def save(self, state: State) -> None:
        """Replace the file by this state."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        waiting = self.path.with_suffix(".part")
        waiting.write_bytes(pack({"identity": self.identity, "run": state}))
        os.replace(waiting, self.path)

    def load(self) -> dict[str, Any] | None:
        """Return the saved state, or None where there is no file.

        Raises:
            ConfigurationError: The file belongs to another run.
            DatasetError: The file is unreadable.
        """
        if not self.path.exists():
            return None
        saved = unpack(self.path.read_bytes())
        if saved.get("identity") != self.identity:
            raise ConfigurationError(
                f"{self.path} is of a run with other data, settings or versions and cannot be resumed; "
                "remove it, or repeat the settings of that run"
            )
        state: dict[str, Any] = saved["run"]
        return state

    def remove(self) -> None:
        """Remove the file: the run is over."""
        self.path.unlink(missing_ok=True)
