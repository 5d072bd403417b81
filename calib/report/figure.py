"""Matplotlib figures as inline SVG that follows the page's light or dark colours."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from deal_hw.types import FloatArray

INK, FAINT, REAL, NOMINAL, CALIBRATED, MINUS, PAPER = (
    "#010101", "#020202", "#030303", "#040404", "#050505", "#060606", "#070707",
)  # fmt: skip
"""Colours to draw with: stand-ins, each of which becomes a variable of the page's style sheet."""

_VARIABLES = {
    INK: "ink", FAINT: "faint", REAL: "real", NOMINAL: "nominal", CALIBRATED: "calibrated", MINUS: "minus",
    PAPER: "paper",
}  # fmt: skip

_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "deal-hw",
    "font.family": "sans-serif",
    "font.size": 9.0,
    # Names are the user's: a dollar sign in one is no formula.
    "text.parse_math": False,
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    # A fixed place: looking for a free one costs a third of the drawing.
    "axes.titley": 1.0,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "lines.linewidth": 1.2,
    "path.simplify_threshold": 0.3,
}
_UNUSED_IDS = re.compile(r' id="[a-zA-Z0-9.]+_\d+"')
_GEOMETRY = re.compile(r' (?:d|x|y|transform|points)="[^"]*"')
_DECIMALS = re.compile(r"-?\d+\.\d{2,}")
_FONT = re.compile(r"'DejaVu Sans'[^;\"]*")


@contextmanager
def drawing() -> Iterator[None]:
    """Set the style of the page's figures and nothing outside."""
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        # The font here only measures text; the reader's browser has the letters.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def svg(figure: Figure, label: str) -> Markup:
    """Return a figure as inline SVG.

    Args:
        figure: The figure, drawn in the colours of this module.
        label: What it shows, for those who do not see it.
    """
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, name in _VARIABLES.items():
        text = text.replace(stand_in, f"var(--{name})")
    # Ids must be unique in the page; only clip paths and marks, named by their digest, are referred to.
    text = _UNUSED_IDS.sub("", text)
    text = _GEOMETRY.sub(lambda found: _DECIMALS.sub(_rounded, found[0]), text)
    text = _FONT.sub("sans-serif", text)
    inches = figure.get_size_inches()
    box = f"0 0 {72 * inches[0]:.1f} {72 * inches[1]:.1f}"
    opening = (
        f'<svg viewBox="{box}" style="max-width:{96 * inches[0]:.0f}px" role="img" '
        f'aria-label="{escape(label)}">'
    )
    return Markup(opening + text[text.index(">") + 1 :])


def _rounded(number: re.Match[str]) -> str:
    return f"{float(number[0]):.1f}"


def log_scale(axis: Any) -> None:
    """Make an axis logarithmic with plain numbers at its ticks."""
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())


def grid(
    rows: int, columns: int, width: float, row_height: float, gap: float = 0.7, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure with rows times columns axes, (rows, columns).

    Args:
        rows: Rows.
        columns: Columns.
        width: Inches.
        row_height: Inches, the gap included.
        gap: Between rows, for tick labels, title and perhaps an axis label [inches].
        options: Passed on to ``Figure.subplots``.
    """
    figure = Figure(figsize=(width, rows * row_height))
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    inch = 1.0 / (rows * row_height)
    figure.subplots_adjust(
        left=0.62 / width, right=1 - 0.15 / width, bottom=0.42 * inch, top=1 - 0.28 * inch,
        hspace=gap / (row_height - gap), wspace=0.75 * columns / max(width - 0.8 * columns, 1.0),
    )  # fmt: skip
    return figure, axes


def envelope(time: FloatArray, values: FloatArray, buckets: int = 350) -> tuple[FloatArray, FloatArray]:
    """Thin a long series so that its picture stays the same: lowest and highest of each bucket, in order.

    Args:
        time: (T,).
        values: (T,); NaN leaves a gap.
        buckets: Buckets; series of up to twice as many samples stay as they are.

    Returns:
        Times and values, up to two a bucket.
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
