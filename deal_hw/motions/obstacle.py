"""A platform ahead of a walking robot, as the operator says it: two numbers."""

from __future__ import annotations

import math
from typing import Final

from deal_hw.errors import ConfigurationError, shown

BLIND: Final = "0,0"
"""The option's text where nothing is said."""
FARTHEST_M: Final = 10.0
HIGHEST_M: Final = 0.5


def parse_obstacle(text: str) -> tuple[float, float]:
    """Return distance and height of a platform [m] that an option says.

    Args:
        text: Such as ``1,0.15``; ``0,0`` says nothing.

    Raises:
        ConfigurationError: It is not two numbers, or they are out of range.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 2 or not all(map(math.isfinite, numbers)):
        raise ConfigurationError(
            f"--obstacle {shown(text)}: give the distance and the height of a platform ahead, such as 1,0.15 "
            f"[m, m], or {BLIND} to say nothing"
        )
    distance, height = numbers
    if not (0.0 <= distance <= FARTHEST_M and 0.0 <= height <= HIGHEST_M):
        raise ConfigurationError(
            f"--obstacle {shown(text)}: allowed are distances of 0 to {FARTHEST_M:g} m and heights of 0 to "
            f"{HIGHEST_M:g} m"
        )
    if distance > 0.0 and height == 0.0:
        raise ConfigurationError(
            f"--obstacle {shown(text)}: a platform of height 0 is no platform; give {BLIND} to say nothing"
        )
    return distance, height
