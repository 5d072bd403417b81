"""How straight a robot walked ahead, from the positions of its base; numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deal_hw.motions.scores.velocity_error import Track

LINE_M: Final = 5.0
"""Length of the line [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Straightness:
    """Where a base is after :data:`LINE_M` ahead.

    Attributes:
        deviation_m: Its distance from the line along its heading at the beginning, positive to the left [m].
        heading_rad: Change of its heading [rad].
    """

    deviation_m: float
    heading_rad: float


def straightness(track: Track, begin_s: float) -> Straightness | None:
    """Return how far a base is from a straight line; None if it did not come that far.

    Args:
        track: The true motion.
        begin_s: When the walk began, on the track's time [s].
    """
    k = int(np.searchsorted(track.time_s, begin_s))
    away, heading = track.place[k:] - track.place[k], np.unwrap(track.heading[k:])
    ahead = np.array([np.cos(heading[0]), np.sin(heading[0])])
    left = np.array([-np.sin(heading[0]), np.cos(heading[0])])
    reached = np.flatnonzero(away @ ahead >= LINE_M)
    if not reached.size:
        return None
    at = int(reached[0])
    return Straightness(deviation_m=float(away[at] @ left), heading_rad=float(heading[at] - heading[0]))
