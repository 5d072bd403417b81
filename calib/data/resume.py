"""Resuming a stopped run: its state between two generations, the checkpoint file, and the run's identity.

A state is nested mappings and lists of plain JSON values and NumPy arrays; nothing is ever pickled.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import io
import json
import os
import time
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from deal_hw.calib.data.parts import BEGIN_S, part_of
from deal_hw.calib.data.problem import Problem
from deal_hw.calibration import Budget, CalibrationMethod, CalibrationResult, ProgressCallback, StateStore
from deal_hw.errors import ConfigurationError, DatasetError, short, shown
from deal_hw.reading import RECORDING_BYTES, object_of, read_arrays, read_bytes, reading
from deal_hw.sim.engine.model import model_digest

State = Mapping[str, Any]
"""Nested mappings and lists of plain JSON values and NumPy arrays."""

FORMAT = "deal_hw.checkpoint/2"
_HEADER, _ARRAY = "state", "__array__"

PACKAGES = ("deal-hw", "mujoco", "numpy", "scipy", "torch", "botorch", "cma", "gpytorch")
"""Packages whose versions may change a run's numbers, where installed."""


class Stateful:
    """An object whose state is some of its attributes: plain values, arrays or objects of this class."""

    STATE: ClassVar[tuple[str, ...]] = ()
    """Names of these attributes; they decide all that follows."""

    def save(self) -> State:
        """Return a copy of the state."""
        held = {name: getattr(self, name) for name in self.STATE}
        return {k: v.save() if isinstance(v, Stateful) else copy.deepcopy(v) for k, v in held.items()}

    def load(self, state: State) -> None:
        """Continue from what :meth:`save` returned."""
        for name in self.STATE:
            held = getattr(self, name)
            if isinstance(held, Stateful):
                held.load(state[name])
            else:
                setattr(self, name, copy.deepcopy(state[name]))


def restore_generator(rng: np.random.Generator, state: State) -> None:
    """Set a generator to a state of ``rng.bit_generator``.

    Raises:
        ConfigurationError: The state belongs to another kind of generator.
    """
    try:
        rng.bit_generator.state = dict(state)
    except (ValueError, TypeError) as err:
        raise ConfigurationError(f"the checkpoint's generator state does not fit: {err}") from err


def pack(state: State) -> bytes:
    """Return a state as the bytes of an NPZ file: a JSON tree whose leaves name arrays beside it.

    Raises:
        TypeError: It holds something other than plain values and arrays of numbers.
    """
    arrays: dict[str, Any] = {}

    def named(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biufc":
            raise TypeError(f"a checkpoint holds plain values and arrays of numbers, not {short(value, 60)}")
        arrays[f"a{len(arrays)}"] = value
        return {_ARRAY: f"a{len(arrays) - 1}"}

    tree = json.dumps({"format": FORMAT, "state": state}, default=named)
    buffer = io.BytesIO()
    arrays[_HEADER] = np.frombuffer(tree.encode("ascii"), dtype=np.uint8)
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def unpack(data: bytes) -> dict[str, Any]:
    """Return the state that :func:`pack` wrote; tuples come back as lists.

    Raises:
        DatasetError: These are not the bytes of a checkpoint.
    """
    with reading("the state", FORMAT):
        arrays, left_out = read_arrays(
            data, lambda dtype, shape: "" if dtype.kind in "biufc" else "no numbers"
        )
        if left_out:
            raise ValueError(f"{short(next(iter(left_out)), 60)} is no array of numbers")
        text = arrays.pop(_HEADER).tobytes()
        header = json.loads(text, object_hook=lambda v: arrays[v[_ARRAY]] if set(v) == {_ARRAY} else v)
        if object_of(header)["format"] != FORMAT:
            raise ValueError(f"format {shown(header['format'])}")
        return dict(object_of(header["state"]))


class SearchCheckpoint:
    """A run's checkpoint file, written whole or not at all. A :class:`deal_hw.calibration.StateStore`.

    Args:
        path: The file.
        identity: Digest of everything that decides the run's numbers; a file of another run is refused.
        fresh: Ignore an existing file; the first state replaces it.
    """

    def __init__(self, path: Path, identity: str, *, fresh: bool = False) -> None:
        self.path, self.identity, self._fresh = path, identity, fresh

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
        """Return the saved state, or None if there is none.

        Raises:
            ConfigurationError: The file belongs to another run.
            DatasetError: The file is unreadable.
        """
        if self._fresh or not self.path.exists():
            return None
        with reading(self.path, "a calibration's state", "remove it and begin again"):
            saved = unpack(read_bytes(self.path, RECORDING_BYTES))
            if saved.get("identity") != self.identity:
                raise ConfigurationError(
                    f"{self.path} belongs to a run with other data, settings or versions and cannot be "
                    "resumed; remove it, or repeat the settings of that run"
                )
            return dict(object_of(saved["run"]))

    def remove(self) -> None:
        """Remove the file after the run."""
        for path in (self.path, self.path.with_suffix(".part")):
            path.unlink(missing_ok=True)


class Restarts:
    """Runs a search repeatedly; one that this run or an interrupted one had finished is not run again.

    It is the running search's store, and puts the last state of each search into the whole run's store. From
    its last state a finished search makes its result again, with the generator as that search left it.
    """

    def __init__(
        self, search: CalibrationMethod[Problem], rng: np.random.Generator, store: StateStore | None
    ) -> None:
        self.search, self._rng, self._store = search, rng, store
        saved = store.load() if store is not None else None
        self._states: list[State] = [] if saved is None else list(saved["searches"])
        self._done: list[tuple[Problem, int, Budget, CalibrationResult]] = []
        self.earlier_steps = 0
        """Physics steps of the searches before this process resumed them."""
        self.earlier_seconds = 0.0
        """Wall clock of the searches before this process resumed them [s]."""

    def run(
        self, problem: Problem, number: int, budget: Budget, progress: ProgressCallback | None
    ) -> CalibrationResult:
        """Return the result of search ``number`` on a problem, 0 for the first; searches run in order.

        A brief search only has to find the neighbourhood, and a part of long recordings shows that.
        See :meth:`CalibrationMethod.run` for the other arguments.
        """
        for before, *same, result in self._done:
            if before is problem and same == [number, budget]:
                return result
        steps, began = problem.steps, time.perf_counter()
        kept = () if self._store is None else (self,)
        searched = part_of(problem, BEGIN_S) if budget.brief else problem
        result = self.search.run(searched, budget, self._rng, progress, *kept)
        self.earlier_steps += result.steps - (problem.steps - steps)
        self.earlier_seconds += max(result.seconds - (time.perf_counter() - began), 0.0)
        self._done.append((problem, number, budget, result))
        return result

    def save(self, state: State) -> None:
        """Store the running search's state; see :class:`deal_hw.calibration.StateStore`."""
        self._states[len(self._done) :] = [state]
        if self._store is not None:
            self._store.save({"searches": self._states})

    def load(self) -> State | None:
        """Return the running search's state, or None where it has not begun."""
        return self._states[len(self._done)] if len(self._done) < len(self._states) else None


def run_identity(
    problem: Problem, method: CalibrationMethod[Problem], budget: Budget, rng: np.random.Generator
) -> str:
    """Return the digest of a run, which identifies its checkpoint; ``rng`` has not drawn yet.

    It covers the recordings' samples and commands, their given noise and latency, model, space, method with
    its settings, budget, generator and versions. The number of threads and what does the
    fits change no result and are left out.

    Raises:
        TypeError: The method holds a value without a digest, such as a function.
    """
    versions = {}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    given = [f.name for f in dataclasses.fields(problem) if f.init]
    return digest(
        {
            "problem": {
                k: getattr(problem, k) for k in given if k not in {"robot", "space", "threads", "tasks"}
            },
            "model": model_digest(problem.robot),
            "setups": {name: model_digest(robot) for name, robot in problem.robot.setups.items()},
            "description": problem.robot.description.to_json(),
            "space": problem.space.to_json(),
            "method": method,
            "budget": budget,
            "generator": rng.bit_generator.state,
            "versions": versions,
        }
    )


def digest(value: Any) -> str:
    """Return the SHA-256 of nested mappings, sequences, dataclasses, methods, arrays and plain values.

    Raises:
        TypeError: A value has another type.
    """
    return hashlib.sha256(json.dumps(value, default=_to_plain).encode()).hexdigest()


def _to_plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": [value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()]}
    if isinstance(value, CalibrationMethod):
        return {"method": type(value).__qualname__, "name": value.name, **vars(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {"dataclass": type(value).__qualname__, **fields}
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} has no digest")
