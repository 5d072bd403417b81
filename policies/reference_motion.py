"""A motion to imitate: what a robot's body did at each control period, as numbers by name."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.errors import ConfigurationError
from deal_hw.types import FloatArray

_MEMBERS: Final = ("names", "rate_hz", "starts", "values")
LEAST_SPREAD: Final = 1e-3
"""Smallest standard deviation by which a feature is divided: one that hardly moves says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceMotion:
    """Pieces of a motion, one after the other.

    Attributes:
        names: Names of the features, (F,), as :meth:`~deal_hw.policies.vector_env.TaskKnowledge.motion` has.
        rate_hz: Rate of the control periods.
        starts: Row at which each piece begins, (P,), the first is 0.
        values: The features, (T, F).

    Raises:
        ConfigurationError: The shapes do not fit, a value is not finite, or no piece has two rows.
    """

    names: tuple[str, ...]
    rate_hz: float
    starts: tuple[int, ...]
    values: FloatArray

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.names):
            raise ConfigurationError(
                f"a reference motion with {len(self.names)} features needs values of shape (T, "
                f"{len(self.names)}), got {self.values.shape}"
            )
        if not np.isfinite(self.values).all():
            raise ConfigurationError("a reference motion has a value that is not finite")
        ends = [*self.starts[1:], len(self.values)]
        if not self.starts or self.starts[0] != 0 or min(np.subtract(ends, self.starts)) < 2:
            raise ConfigurationError(
                f"each piece of a reference motion needs at least two rows, and the first begins at row 0; "
                f"got {len(self.values)} rows and pieces from {list(self.starts)} on"
            )

    @property
    def pairs(self) -> FloatArray:
        """Each row with the next one of its piece, (M, 2 F)."""
        both = np.hstack([self.values[:-1], self.values[1:]])
        return np.delete(both, np.asarray(self.starts[1:], dtype=int) - 1, axis=0)

    @property
    def centre(self) -> FloatArray:
        """Mean of the features, (F,)."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def spread(self) -> FloatArray:
        """Standard deviation of the features, (F,), at least ``LEAST_SPREAD``."""
        return np.asarray(np.maximum(self.values.std(axis=0), LEAST_SPREAD))

    def check(self, names: Sequence[str], rate_hz: float) -> None:
        """Check that it is of a robot's features and rate.

        Raises:
            ConfigurationError: It is of others.
        """
        if self.names != tuple(names) or self.rate_hz != rate_hz:
            other = sorted(set(names) ^ set(self.names))
            raise ConfigurationError(
                f"the reference motion is of another robot: {len(self.names)} features at {self.rate_hz:g} "
                f"Hz, this one has {len(names)} at {rate_hz:g} Hz (not in both: "
                f"{', '.join(other[:3]) or 'none'})"
            )

    def write(self, path: Path) -> None:
        """Write it as NPZ, values in single precision."""
        np.savez_compressed(
            path,
            names=np.array(self.names),
            rate_hz=np.array(self.rate_hz),
            starts=np.array(self.starts, dtype=np.int64),
            values=self.values.astype(np.float32),
        )

    @classmethod
    def read(cls, path: Path) -> ReferenceMotion:
        """Return the motion in a file of :meth:`write`.

        Raises:
            ConfigurationError: The file is missing, or no such file.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                found: dict[str, Any] = {name: file[name] for name in _MEMBERS}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as err:
            raise ConfigurationError(f"{path} is no reference motion: {err}") from err
        return cls(
            names=tuple(map(str, found["names"])),
            rate_hz=float(found["rate_hz"]),
            starts=tuple(map(int, found["starts"])),
            values=found["values"].astype(np.float64),
        )
