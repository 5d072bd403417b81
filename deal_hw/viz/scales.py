"""The initial y range of a plot, and the corner in which its legend covers least.

Rerun labels an axis at multiples of a power of ten only. So a range of its own choice often has one label, or
none; ours has two at least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from deal_hw.types import FloatArray

Corner = Literal["LeftTop", "RightTop", "LeftBottom", "RightBottom"]
Curve = tuple[FloatArray, FloatArray]
"""Times [s] and values, of one shape."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSettings:
    """Settings of the initial view of a plot.

    Attributes:
        margin: Room above and below the values, in shares of their span.
        least_share: The least span, in shares of the largest value, so that small changes of a large value
            look small.
        least_span: The least span of values near zero, in their unit, so that rounding does not look like a
            signal.
        ticks: Least number of labels. Two give the scale; with three, values from 0.1 to 1.4 got an axis from
            0 to 2.
        time_ticks: Least number of time labels of plots beside each other.
        label_px: Rerun leaves out labels that are closer together [px].
        window_px: Height that plots share in a window of 1280 x 800 [px].
        frame_px: Height of a plot's title and time labels [px].
        window_width_px: Width that plots share in that window, less labels [px].
        time_label_px: Time labels that are closer together are left out [px].
        legend: Width and height of a legend, in shares of the plot.
    """

    margin: float = 0.06
    least_share: float = 0.01
    least_span: float = 1e-3
    ticks: int = 2
    time_ticks: int = 3
    label_px: float = 24.0
    window_px: float = 700.0
    frame_px: float = 50.0
    window_width_px: float = 720.0
    time_label_px: float = 70.0
    legend: tuple[float, float] = (0.35, 0.35)


SETTINGS = ScaleSettings()


def visible_range(
    curves: Sequence[Curve],
    within: tuple[float, float] = (-np.inf, np.inf),
    rows: int = 2,
    settings: ScaleSettings = SETTINGS,
) -> tuple[float, float]:
    """Return the lower and upper end of the y axis.

    Args:
        curves: The drawn curves; values that are not finite are left out.
        within: Values beyond these ends are cut off.
        rows: Number of plots that share the window's height.
        settings: Margins and numbers of labels.
    """
    known = [values[np.isfinite(values)] for _, values in curves]
    whole = np.clip(np.concatenate(known), *within) if known else np.zeros(0)
    low, high = (float(whole.min()), float(whole.max())) if whole.size else (0.0, 0.0)
    least = max(settings.least_share * max(abs(low), abs(high)), settings.least_span)
    room = max(settings.margin * (high - low), (least - (high - low)) / 2)
    low, high = low - room, high + room
    most = (settings.window_px / rows - settings.frame_px) / settings.label_px
    step = 10.0 ** np.ceil(np.log10((high - low) / most))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    while last - first + 1 < settings.ticks:
        # The end that is nearer to its next label moves beyond it: a label at the edge is cut off.
        if low - (first - 1) * step <= (last + 1) * step - high:
            first -= 1
            low = (first - settings.margin) * step
        else:
            last += 1
            high = (last + settings.margin) * step
    return float(low), float(high)


def time_columns(seconds: float, settings: ScaleSettings = SETTINGS) -> int:
    """Return how many plots may stand beside each other: one where two would leave too few time labels.

    Args:
        seconds: Length of the recording [s].
        settings: Widths and numbers of labels.
    """
    return (
        1
        if _time_labels(seconds, 1, settings) >= settings.time_ticks > _time_labels(seconds, 2, settings)
        else 2
    )


def _time_labels(seconds: float, columns: int, settings: ScaleSettings) -> int:
    # Rerun labels time axes, too, at multiples of a power of ten only.
    most = settings.window_width_px / columns / settings.time_label_px
    step = 10.0 ** np.ceil(np.log10(max(seconds, 1e-9) / most))
    return int(seconds / step + 1e-9) + 1


def clear_corner(
    curves: Sequence[Curve], limits: tuple[float, float], settings: ScaleSettings = SETTINGS
) -> Corner:
    """Return the corner of a plot in which a legend covers least of the curves.

    Args:
        curves: What is drawn.
        limits: Lower and upper end of the y axis.
        settings: The size of a legend.
    """
    spans = [time_s for time_s, _ in curves if time_s.size]
    start, end = (min(t.min() for t in spans), max(t.max() for t in spans)) if spans else (0.0, 1.0)
    width, height = settings.legend
    covered: dict[Corner, int] = dict.fromkeys(("RightTop", "LeftTop", "RightBottom", "LeftBottom"), 0)
    for time_s, values in curves:
        across = (time_s - start) / max(end - start, 1e-9)
        up = (values - limits[0]) / (limits[1] - limits[0])
        for corner in covered:
            beside = across > 1 - width if corner.startswith("Right") else across < width
            inside = up > 1 - height if corner.endswith("Top") else up < height
            covered[corner] += int(np.count_nonzero(beside & inside))
    return min(covered, key=covered.__getitem__)
