"""One interface to model fields for a batch of simulations and for a single model.

The functions in ``deal_hw.sim.parameters`` write through it. So the same code changes the calibrator's batch,
the emulator's hidden model and the model written for the user.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from deal_hw.errors import UnknownNameError

Array = npt.NDArray[np.float64]


class Fields(Protocol):
    """Writable model fields of N simulations."""

    @property
    def model(self) -> Any:
        """The MjModel of names and nominal values; never written."""
        ...

    def get(self, name: str) -> Array:
        """Return the writable values of an MjModel field, (N, ...)."""
        ...


class BatchFields:
    """Fields of a ``mujoco.batch.Batch``."""

    def __init__(self, batch: Batch, nominal: mujoco.MjModel) -> None:
        self._batch = batch
        self.model = nominal

    def get(self, name: str) -> Array:
        """Return the live per-simulation values, (N, ...)."""
        values: Array = self._batch.expand(name)
        return values


class ModelFields:
    """Fields of one MjModel, as a batch of one."""

    def __init__(self, model: mujoco.MjModel, nominal: mujoco.MjModel) -> None:
        self._target = model
        self.model = nominal

    def get(self, name: str) -> Array:
        """Return a writable view, (1, ...)."""
        values: Array = getattr(self._target, name)[None]
        return values


_TYPES = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
}
_COUNTS = {"body": "nbody", "joint": "njnt", "actuator": "nu", "geom": "ngeom", "tendon": "ntendon"}

ELEMENTS = tuple(_TYPES)
"""Types of elements that parameters change."""


def unknown_name(what: str, given: str, allowed: Iterable[str]) -> UnknownNameError:
    """Return the error for a name that is not known; it also says the nearest one, if any is near."""
    error = UnknownNameError(what, given, allowed)
    near = difflib.get_close_matches(given, error.allowed, n=1)
    if near:
        error.args = (f"{error}; did you mean {near[0]!r}?",)
    return error


def element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Return the names of all elements of a kind ("body", "joint", "actuator", "geom", "tendon")."""
    count = getattr(model, _COUNTS[kind])
    return [mujoco.mj_id2name(model, _TYPES[kind], i) or "" for i in range(count)]


def as_slice(numbers: list[int]) -> slice | list[int]:
    """Return numbers as a slice where they follow each other: a view costs less than a copy in each step."""
    if numbers and numbers == list(range(numbers[0], numbers[0] + len(numbers))):
        return slice(numbers[0], numbers[0] + len(numbers))
    return numbers


def element_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Return the id of an element.

    Raises:
        UnknownNameError: There is no such element; the message lists the names.
    """
    index = int(mujoco.mj_name2id(model, _TYPES[kind], name))
    if index < 0:
        raise UnknownNameError(f"MuJoCo {kind}", name, (n for n in element_names(model, kind) if n))
    return index
