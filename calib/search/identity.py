"""The identity of a run: a digest of everything that decides its numbers."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.search.checkpoint import generator_state
from deal_hw.calibration import Budget, CalibrationMethod
from deal_hw.sim.engine.digest import model_digest

PACKAGES = ("deal-hw", "mujoco", "numpy", "scipy", "torch")
OPTIONAL = ("botorch", "cma", "gpytorch")
"""Whose versions may change a run's numbers; the optional ones where they are installed."""


def run_identity(
    problem: Problem, method: CalibrationMethod[Problem], budget: Budget, rng: np.random.Generator
) -> str:
    """Return the digest of a run, by which its checkpoint is known.

    It covers the recordings' samples and commands, what is known of their noise and latency, model, space,
    method with its settings, budget, generator and versions; not the number of threads, which changes no
    number.

    Args:
        problem: Data and simulator.
        method: The method.
        budget: How much it may use.
        rng: The run's generator, before it has drawn anything.

    Raises:
        TypeError: The method holds something that cannot be told apart, such as a function.
    """
    return digest(
        {
            "problem": {
                field.name: getattr(problem, field.name)
                for field in dataclasses.fields(problem)
                if field.init and field.name not in {"robot", "space", "threads"}
            },
            "model": model_digest(problem.robot),
            "description": problem.robot.description.to_json(),
            "space": problem.space.to_json(),
            "method": method_settings(method),
            "budget": budget,
            "generator": generator_state(rng),
            "versions": _versions(),
        }
    )


def _versions() -> dict[str, str]:
    found = {name: metadata.version(name) for name in PACKAGES}
    for name in OPTIONAL:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def method_settings(method: CalibrationMethod[Problem]) -> dict[str, Any]:
    """Return a method's class, name and settings, those of a search inside it too."""
    found: dict[str, Any] = {"class": type(method).__qualname__, "name": method.name}
    for attribute in ("settings", "policy"):
        if hasattr(method, attribute):
            found[attribute] = getattr(method, attribute)
    if hasattr(method, "search"):
        found["search"] = method_settings(method.search)
    return found


def digest(value: Any) -> str:
    """Return the SHA-256 of nested mappings, sequences, dataclasses, arrays and plain values.

    Raises:
        TypeError: There is something else among them.
    """
    whole = hashlib.sha256()
    _feed(whole, value)
    return whole.hexdigest()


def _feed(whole: hashlib._Hash, value: Any) -> None:
    if isinstance(value, np.ndarray):
        whole.update(f"array {value.dtype.str} {value.shape}".encode())
        whole.update(np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        pairs = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        _feed(whole, {"dataclass": type(value).__qualname__, **pairs})
    elif isinstance(value, Mapping):
        whole.update(f"mapping {len(value)}".encode())
        for key, item in value.items():
            _feed(whole, key)
            _feed(whole, item)
    elif isinstance(value, list | tuple):
        whole.update(f"list {len(value)}".encode())
        for item in value:
            _feed(whole, item)
    elif isinstance(value, np.generic):
        _feed(whole, value.item())
    elif value is None or isinstance(value, bool | int | float | str):
        whole.update(json.dumps([type(value).__name__, value]).encode())
    else:
        raise TypeError(f"a {type(value).__name__} has no digest")
