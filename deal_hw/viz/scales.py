"""The initial y range of a plot, and the corner in which its legend covers least.

Rerun labels an axis at multiples of a power of ten only. So a range of its own choice often has one label, or
none; ours has two at least.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from deal_hw.types import FloatArray

Corner = Literal["LeftTop", "RightTop", "LeftBottom", "RightBottom"]
Curve = tuple[FloatArray, FloatArray]
"""Times [s] and values, of one shape."""


MARGIN: Final = 0.06
"""Room above and below the values, in shares of their span."""
LEAST_SHARE: Final = 0.01
"""The least span, in shares of the largest value, so that small changes of a large value look small."""
LEAST_SPAN: Final = 1e-3
"""The least span of values near zero, in their unit, so that rounding does not look like a signal."""
LEAST_TICKS: Final = 2
"""Least number of labels. Two give the scale; with three, values from 0.1 to 1.4 got an axis from 0 to 2."""
LEAST_TIME_TICKS: Final = 3
"""Least number of time labels of plots beside each other."""
LABEL_PX: Final = 24.0
"""Rerun leaves out labels that are closer together [px]."""
WINDOW_PX: Final = 700.0
"""Height that plots share in a window of 1280 x 800 [px]."""
FRAME_PX: Final = 50.0
"""Height of a plot's title and time labels [px]."""
WINDOW_WIDTH_PX: Final = 720.0
"""Width that plots share in that window, less labels [px]."""
TIME_LABEL_PX: Final = 70.0
"""Time labels that are closer together are left out [px]."""
LEGEND: Final = (0.35, 0.35)
"""Width and height of a legend, in shares of the plot."""


def visible_range(
    curves: Sequence[Curve],
    within: tuple[float, float] = (-np.inf, np.inf),
    rows: int = 2,
) -> tuple[float, float]:
    """Return the lower and upper end of the y axis.

    Args:
        curves: The drawn curves; values that are not finite are left out.
        within: Values beyond these ends are cut off.
        rows: Number of plots that share the window's height.
    """
    known = [values[np.isfinite(values)] for _, values in curves]
    whole = np.clip(np.concatenate(known), *within) if known else np.zeros(0)
    low, high = (float(whole.min()), float(whole.max())) if whole.size else (0.0, 0.0)
    least = max(LEAST_SHARE * max(abs(low), abs(high)), LEAST_SPAN)
    room = max(MARGIN * (high - low), (least - (high - low)) / 2)
    low, high = low - room, high + room
    most = (WINDOW_PX / rows - FRAME_PX) / LABEL_PX
    step = 10.0 ** np.ceil(np.log10((high - low) / most))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    while last - first + 1 < LEAST_TICKS:
        # The end that is nearer to its next label moves beyond it: a label at the edge is cut off.
        if low - (first - 1) * step <= (last + 1) * step - high:
            first -= 1
            low = (first - MARGIN) * step
        else:
            last += 1
            high = (last + MARGIN) * step
    return float(low), float(high)


def time_columns(seconds: float) -> int:
    """Return how many plots may stand beside each other: one where two would leave too few time labels.

    Args:
        seconds: Length of the recording [s].
    """
    return 1 if _time_labels(seconds, 1) >= LEAST_TIME_TICKS > _time_labels(seconds, 2) else 2


def _time_labels(seconds: float, columns: int) -> int:
    # Rerun labels time axes, too, at multiples of a power of ten only.
    most = WINDOW_WIDTH_PX / columns / TIME_LABEL_PX
    step = 10.0 ** np.ceil(np.log10(max(seconds, 1e-9) / most))
    return int(seconds / step + 1e-9) + 1


def clear_corner(curves: Sequence[Curve], limits: tuple[float, float]) -> Corner:
    """Return the corner of a plot in which a legend covers least of the curves.

    Args:
        curves: What is drawn.
        limits: Lower and upper end of the y axis.
    """
    spans = [time_s for time_s, _ in curves if time_s.size]
    start, end = (min(t.min() for t in spans), max(t.max() for t in spans)) if spans else (0.0, 1.0)
    width, height = LEGEND
    covered: dict[Corner, int] = dict.fromkeys(("RightTop", "LeftTop", "RightBottom", "LeftBottom"), 0)
    for time_s, values in curves:
        across = (time_s - start) / max(end - start, 1e-9)
        up = (values - limits[0]) / (limits[1] - limits[0])
        for corner in covered:
            beside = across > 1 - width if corner.startswith("Right") else across < width
            inside = up > 1 - height if corner.endswith("Top") else up < height
            covered[corner] += int(np.count_nonzero(beside & inside))
    return min(covered, key=covered.__getitem__)
