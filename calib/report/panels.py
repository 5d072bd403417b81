"""Charts with readable text at any width: an SVG that stretches, with ticks and labels as HTML around it.

The page's script reads the series back from the paths, so nothing is stored twice. The charts also work
without it. Colours and line styles are classes of the page's style sheet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from markupsafe import Markup, escape

from deal_hw.types import FloatArray

WIDTH, HEIGHT = 8000, 2000
"""A chart's own units: whole numbers in its paths are finer than a screen's pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """One series of a panel.

    Attributes:
        name: Name for the reader.
        style: Class of the style sheet, such as "real".
        x: (n,), ascending.
        y: (n,); NaN leaves a gap.
        kind: A line, a line with dots, bars from 0, or the area down to 0.
    """

    name: str
    style: str
    x: FloatArray
    y: FloatArray
    kind: Literal["line", "dots", "bars", "area"] = "line"


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A chart.

    Attributes:
        title: Quantity with its unit in brackets.
        x_title: The same of the other axis.
        series: The series, later ones over earlier ones.
        x: Ends of the axis.
        y: Ends of the axis.
        log_y: Draw the logarithm.
        bands: Shaded ranges of y: low, high.
        whole_x: Ticks at whole numbers only.
        no_y: No ticks at y.
        linked: Zoom and cross-hair are shared with the group's other linked panels.
        style: Class of the figure, such as its width.
        label: Text for screen readers; the title if empty.
    """

    title: str
    x_title: str
    series: Sequence[Series]
    x: tuple[float, float]
    y: tuple[float, float]
    log_y: bool = False
    bands: Sequence[tuple[float, float]] = ()
    whole_x: bool = False
    no_y: bool = False
    linked: bool = False
    style: str = ""
    label: str = ""

    def html(self) -> Markup:
        """Return the panel as a figure."""
        low, high = self._scaled(np.array(self.y))
        parts = [
            f'<rect class="band" x="0" width="{WIDTH}" y="{top}" height="{max(bottom - top, 1)}"/>'
            for top, bottom in (self._rows(np.array([b, a]), low, high) for a, b in self.bands)
        ]
        ticks = [] if self.no_y else self._y_ticks()
        at = self._rows(np.array([value for value, _ in ticks]), low, high)
        parts.append(f'<path class="grid" d="{"".join(f"M0 {y}H{WIDTH}" for y in at)}"/>' if len(at) else "")
        parts += [self._path(series, low, high) for series in self.series]
        words = [
            f'<i class="yt" style="top:{100 * y / HEIGHT:.2f}%">{word}</i>'
            for y, (_, word) in zip(at, ticks, strict=True)
        ]
        begin, span = self.x[0], self.x[1] - self.x[0]
        words += [
            f'<i class="xt" style="left:{100 * (value - begin) / span:.2f}%">{word}</i>'
            for value, word in ticks_of(*self.x, 6, whole=self.whole_x)
        ]
        flags = f"{' data-linked' if self.linked else ''}{' data-log' if self.log_y else ''}"
        return Markup(
            f'<figure class="panel {self.style}" data-x="{_ends(self.x)}" data-y="{_ends(self.y)}"{flags}>'
            f"<figcaption>{escape(self.title)}</figcaption>"
            f'<div class="plot" tabindex="0" role="img" aria-label="{escape(self.label or self.title)}">'
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" preserveAspectRatio="none" aria-hidden="true">'
            f"{''.join(parts)}</svg>{''.join(words)}</div>"
            f'<div class="xtitle">{escape(self.x_title)}</div></figure>'
        )

    def _scaled(self, values: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log10(values) if self.log_y else values

    def _rows(self, values: FloatArray, low: float, high: float) -> list[int]:
        """Return heights in the chart's own units, 0 at its top; values far outside are clipped."""
        share = np.clip((high - self._scaled(values)) / (high - low), -1.0, 2.0)
        return [round(HEIGHT * s) for s in share.tolist()]

    def _y_ticks(self) -> list[tuple[float, str]]:
        if not self.log_y:
            return ticks_of(*self.y, 6)
        first, last = (math.floor(math.log10(self.y[0])), math.ceil(math.log10(self.y[1])))
        steps = (1, 2, 5) if last - first <= 2 else (1,)
        every = max((last - first) // 4, 1)
        powers = [s * 10.0**k for k in range(first, last + 1, every) for s in steps]
        return [(p, f"{p:g}") for p in powers if self.y[0] <= p <= self.y[1]]

    def _path(self, series: Series, low: float, high: float) -> str:
        seen = np.isfinite(series.x) & np.isfinite(self._scaled(series.y))
        across = WIDTH * (series.x[seen] - self.x[0]) / (self.x[1] - self.x[0])
        x = np.round(across).astype(int).tolist()
        y = self._rows(series.y[seen], low, high)
        if series.kind == "bars":
            zero = self._rows(np.zeros(1), low, high)[0]
            d = "".join(f"M{a} {zero}V{b}" for a, b in zip(x, y, strict=True))
        else:
            # A gap begins a new line; a lone sample is a dot.
            begins = np.diff(np.flatnonzero(seen), prepend=-9) > 1
            alone = begins & np.append(begins[1:], True)
            d = "".join(
                f"{'M' if first else 'L'}{a} {b}{'h0' if lone else ''}"
                for a, b, first, lone in zip(x, y, begins, alone, strict=True)
            )
        if series.kind == "area":
            zero = self._rows(np.zeros(1), low, high)[0]
            d += f"V{zero}H{x[0]}Z" if x else ""
        name = f' data-name="{escape(series.name)}"' if series.kind in ("line", "dots", "bars") else ""
        dots = ""
        if series.kind == "dots":
            d_dots = "".join(f"M{a} {b}h0" for a, b in zip(x, y, strict=True))
            dots = f'<path class="dot {series.style}" d="{d_dots}"/>'
        return f'<path class="{series.kind} {series.style}"{name} d="{d}"/>{dots}'


def ticks_of(low: float, high: float, most: int, *, whole: bool = False) -> list[tuple[float, str]]:
    """Return about ``most`` round values between two ends, with labels of equal precision."""
    step = nice_step((high - low) / most)
    step = max(round(step), 1) if whole else step
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    largest = max(abs(low), abs(high))
    if decimals > 4 or largest >= 1e6:
        form = f".{math.ceil(math.log10(largest / step) + 1e-9) + 1}g"
    else:
        form = f".{decimals}f"
    return [(k * step, f"{k * step:{form}}".replace("-", "−")) for k in range(first, last + 1)]


def nice_step(least: float) -> float:
    """Return the smallest of 1, 2, 5, 10, ... times a power of ten that is not below a value above 0."""
    power = 10.0 ** math.floor(math.log10(least))
    return float(next(power * s for s in (1, 2, 5, 10) if power * s >= least * (1 - 1e-9)))


def _ends(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.8g} {ends[1]:.8g}"


def envelope(time: FloatArray, values: FloatArray, buckets: int = 350) -> tuple[FloatArray, FloatArray]:
    """Reduce a long series, (T,), without a visible change: lowest and highest of each bucket, in order.

    A value of NaN leaves a gap. Series of up to twice as many samples as buckets are unchanged.
    """
    if len(values) <= 2 * buckets:
        return time, values
    keep: list[int] = []
    for part in np.array_split(np.arange(len(values)), buckets):
        finite = part[np.isfinite(values[part])]
        if len(finite) < len(part):
            keep.append(int(part[~np.isfinite(values[part])][0]))
        if len(finite):
            keep.extend({int(finite[np.argmin(values[finite])]), int(finite[np.argmax(values[finite])])})
    order = np.unique(keep)
    return time[order], values[order]
