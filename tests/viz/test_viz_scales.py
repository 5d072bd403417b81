"""Ranges of axes by hand-computed numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.viz.scales import (
    FRAME_PX,
    LABEL_PX,
    LEAST_SHARE,
    LEAST_SPAN,
    LEAST_TICKS,
    WINDOW_PX,
    clear_corner,
    time_columns,
    visible_range,
)


def curve(*values: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve of these values, a second apart."""
    return np.arange(len(values), dtype=float), np.array(values)


def test_room_above_and_below() -> None:
    """0 to 8 takes 6 % of 8 to either side; the labels 0, 1, .. 8 are there already."""
    assert visible_range([curve(0, 8), curve(np.nan, 4)]) == pytest.approx((-0.48, 8.48))


def test_missing_labels_are_taken_in() -> None:
    """Four plots leave 125 px each, room for 5.2 labels: those at 0, 0.1, .. 0.8 are too many.

    So labels are at 0 and 1, with room beyond the last.
    """
    assert visible_range([curve(0, 0.8)], rows=4) == pytest.approx((-0.048, 1.06))


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3))
def test_the_axis_is_not_twice_the_data(middle: float, span: float) -> None:
    """In the window's two rows of plots, whatever the values; only those that hardly move get more.

    300 px have room for 12.5 labels, so a step is at most 10 / 12.5 of the span and its margins, 1.12 spans:
    0.9 spans. At worst one label is in the middle, and the next one is 0.9 - 0.56 spans beyond an end.
    """
    low, high = visible_range([curve(middle - span / 2, middle + span / 2)])
    if span > 2 * (LEAST_SHARE * abs(middle) + LEAST_SPAN):
        assert high - low <= 1.55 * span


def test_signals_that_hardly_move() -> None:
    """A constant 40 is shown from 39.8 to 40.2 at least; nothing at all from -1 to 1 thousandths."""
    low, high = visible_range([curve(40, 40, 40)])
    assert low <= 39.8 and high >= 40.2 and high - low < 4
    low, high = visible_range([curve(1e-9, -1e-9)])
    assert 0.5e-3 <= high <= 2e-3 and -2e-3 <= low <= -0.5e-3
    assert visible_range([]) == visible_range([curve(np.nan)]) == visible_range([curve(0.0)])


def test_the_rest_is_cut_off() -> None:
    """Beyond the given ends nothing is shown but the margin."""
    assert visible_range([curve(0, 100)], within=(-8, 8)) == pytest.approx((-0.48, 8.48))


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.integers(1, 4))
def test_labels_fit(middle: float, span: float, rows: int) -> None:
    """Of any values, all are inside, with two labels at least and none too close to the next."""
    low, high = visible_range([curve(middle - span / 2, middle + span / 2)], rows=rows)
    assert low < middle - span / 2 and middle + span / 2 < high
    height = WINDOW_PX / rows - FRAME_PX
    steps = 10.0 ** np.arange(-6, 6)
    labels = np.floor(high / steps + 1e-9) - np.ceil(low / steps - 1e-9) + 1
    apart = height * steps / (high - low)
    assert ((labels >= LEAST_TICKS) & (apart >= 0.5 * LABEL_PX)).any()


def test_the_legend_keeps_out_of_the_way() -> None:
    """A curve that rises leaves the top left free, one that falls the top right."""
    rising, falling = curve(0, 1, 2, 3, 4, 5), curve(5, 4, 3, 2, 1, 0)
    assert clear_corner([rising], (0, 5)) == "LeftTop"
    assert clear_corner([falling], (0, 5)) == "RightTop"
    assert clear_corner([], (0, 5)) == "RightTop"


def test_columns_by_time_labels() -> None:
    """4 s have a label a second in half of the width, 8 s in the whole; 23 s have 0, 10, 20 in the half."""
    assert [time_columns(seconds) for seconds in (0.0, 4.0, 8.0, 23.0)] == [2, 2, 1, 2]
