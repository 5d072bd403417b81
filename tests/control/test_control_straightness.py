"""How straight a robot walked."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.motions.scores.straightness import straightness
from deal_hw.motions.scores.velocity_error import Track


def test_the_deviation_is_from_the_line_of_the_first_heading() -> None:
    """On an arc of 20 m radius to the left, begun at 30 degrees, 5 m ahead is 0.635 m to the left."""
    time_s = np.linspace(0.0, 10.0, 1001)
    turn, first = 0.05 * np.maximum(time_s - 2.0, 0.0), np.pi / 6
    ahead, left = 20.0 * np.sin(turn), 20.0 * (1.0 - np.cos(turn))
    place = np.stack(
        (
            3.0 + np.cos(first) * ahead - np.sin(first) * left,
            -1.0 + np.sin(first) * ahead + np.cos(first) * left,
        ),
        axis=1,
    )
    found = straightness(Track(time_s, place, first + turn), 2.0)
    assert found is not None and found.deviation_m == pytest.approx(20.0 - np.sqrt(400.0 - 25.0), abs=0.01)
    assert found.heading_rad == pytest.approx(np.arcsin(0.25), abs=0.01)
    short = Track(time_s[:500], place[:500], first + turn[:500])
    assert straightness(short, 2.0) is None
