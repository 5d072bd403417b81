"""The heading of a base, against an angle worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from deal_hw.rotations import heading


def test_a_heading_is_that_of_the_x_axis_from_above() -> None:
    """By hand: 2 rad about the vertical, alone and after a pitch of 0.3 rad, which does not change it."""
    turn = np.array([np.cos(1.0), 0.0, 0.0, np.sin(1.0)])
    c, s = np.cos(0.15), np.sin(0.15)
    pitched = np.array([turn[0] * c, -turn[3] * s, turn[0] * s, turn[3] * c])
    np.testing.assert_allclose(heading(np.stack([turn, pitched])), 2.0, atol=1e-12)
    assert float(heading(turn)) == pytest.approx(2.0)
