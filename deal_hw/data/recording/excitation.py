"""How much the robot moves in a recording. Calibration needs enough motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from deal_hw.data.checks.following import followed_part
from deal_hw.schema import plain
from deal_hw.types import Trajectory

LEAST_MOTION = 20.0
"""Least motion of a joint [multiples of its sensor's noise]."""
FEWEST_CHANGES = 5
"""Fewest changes of the target."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """Movement and commands of a recording; tuples in the order of the joints (J) or actuated joints (A).

    Attributes:
        duration_s: Device time [s].
        position_range: Largest minus smallest position, (J,) [m or rad].
        speed_max: Greatest speed, (J,) [m/s or rad/s].
        speed_rms: Root mean square of the velocity, (J,) [m/s or rad/s].
        reversals: How often the velocity changes sign beyond a tenth of its greatest value, (J,).
        target_range: Largest minus smallest target sent, (A,) [m or rad].
        target_changes: Commands whose target differs from the one before, (A,).
    """

    duration_s: float
    position_range: tuple[float, ...]
    speed_max: tuple[float, ...]
    speed_rms: tuple[float, ...]
    reversals: tuple[int, ...]
    target_range: tuple[float, ...]
    target_changes: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = plain(self)
        return values


def excitation(trajectory: Trajectory) -> Excitation:
    """Return how much the robot moves in a recording, up to where its joints no longer follow their commands.

    Values that are not finite are left out.
    """
    trajectory = followed_part(trajectory)
    velocity = np.where(np.isfinite(trajectory.velocity), trajectory.velocity, 0.0)
    targets = trajectory.position_target
    return Excitation(
        duration_s=trajectory.duration_s,
        position_range=_span(trajectory.position),
        speed_max=tuple(np.max(np.abs(velocity), axis=0, initial=0.0).tolist()),
        speed_rms=tuple(np.sqrt(np.sum(velocity**2, axis=0) / max(len(velocity), 1)).tolist()),
        reversals=tuple(_reversals(column) for column in velocity.T),
        target_range=_span(targets),
        target_changes=tuple(np.sum(np.diff(targets, axis=0) != 0, axis=0).tolist()),
    )


def _span(values: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[float, ...]:
    """Return the range of each column, over its finite entries."""
    finite = np.isfinite(values)
    high = np.max(values, axis=0, where=finite, initial=-np.inf)
    low = np.min(values, axis=0, where=finite, initial=np.inf)
    return tuple(np.where(high >= low, high - low, 0.0).tolist())


def _reversals(velocity: np.ndarray[Any, np.dtype[np.float64]]) -> int:
    # The threshold keeps noise around zero from counting as movement.
    fast = velocity[np.abs(velocity) > 0.1 * np.max(np.abs(velocity), initial=0.0)]
    return int(np.sum(np.diff(np.sign(fast)) != 0))
