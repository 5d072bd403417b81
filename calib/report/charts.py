"""The page's charts, as inline SVG that follows the page's light or dark colours."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from deal_hw.calib.report.gather import OverlayPanel, Residuals
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import ParameterSpace
from deal_hw.types import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ChartSettings:
    """How large charts are.

    Attributes:
        width: Width of a chart [inches]; the page scales charts to its own.
        channels: Channels whose residuals are drawn: those with the largest.
        panels: Channels whose motion is drawn: the first ones.
        points: Points of all motion on the page; long series are thinned to their lows and highs.
        lags: Longest lag of autocorrelations [samples].
        numbered: Up to so many parameters the correlations are written into their cells.
    """

    width: float = 10.2
    channels: int = 8
    panels: int = 24
    points: int = 60_000
    lags: int = 20
    numbered: int = 12


SETTINGS = ChartSettings()

INK, FAINT, REAL, NOMINAL, CALIBRATED, MINUS, PAPER = (
    "#010101",
    "#020202",
    "#030303",
    "#040404",
    "#050505",
    "#060606",
    "#070707",
)
"""Colours to draw with: stand-ins, each of which becomes a variable of the page's style sheet."""

_VARIABLES = {
    INK: "ink",
    FAINT: "faint",
    REAL: "real",
    NOMINAL: "nominal",
    CALIBRATED: "calibrated",
    MINUS: "minus",
    PAPER: "paper",
}

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
        left=0.62 / width,
        right=1 - 0.15 / width,
        bottom=0.42 * inch,
        top=1 - 0.28 * inch,
        hspace=gap / (row_height - gap),
        wspace=0.75 * columns / max(width - 0.8 * columns, 1.0),
    )
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


def overlay(shown: OverlayPanel, panels: int = SETTINGS.panels) -> Markup:
    """Draw real, nominal and calibrated motion, one panel a channel.

    Args:
        shown: The motion.
        panels: Panels of all overlays on the page, which share the points there may be.
    """
    M = min(len(shown.names), SETTINGS.panels)
    buckets = int(np.clip(SETTINGS.points / (6 * panels), 80, 350))
    columns = 1 if M <= 2 else 2
    rows = -(-M // columns)
    with drawing():
        figure, axes = grid(
            rows, columns, SETTINGS.width, 1.55 if columns == 1 else 1.3, gap=0.38, sharex=True
        )
        for m, axis in enumerate(axes.ravel()):
            if m >= M:
                axis.set_visible(False)
                continue
            for values, colour, style in (
                (shown.real, REAL, "-"),
                (shown.nominal, NOMINAL, (0, (3, 2))),
                (shown.calibrated, CALIBRATED, "-"),
            ):
                width = 2.4 if colour == REAL else 1.1
                x, y = envelope(shown.time_s, values[:, m], buckets)
                axis.plot(x, y, color=colour, linestyle=style, linewidth=width)
            _frame(axis, shown.real[:, m])
            axis.set_title(f"{shown.names[m]} [{shown.units[m]}]")
            if m >= M - columns:
                axis.set_xlabel("time [s]")
                axis.tick_params(labelbottom=True)
        return svg(figure, f"{shown.title}: real, nominal and calibrated motion of {M} channels over time")


def _frame(axis: Any, real: FloatArray) -> None:
    """Frame what was measured: a model that runs away must not shrink it."""
    finite = real[np.isfinite(real)]
    if len(finite) == 0:
        return
    low, high = float(finite.min()), float(finite.max())
    margin = 0.25 * (high - low) or 1e-3
    axis.set_ylim(low - margin, high + margin)
    axis.yaxis.set_major_locator(MaxNLocator(4))


def residuals(shown: Residuals) -> tuple[Markup, str]:
    """Draw whitened residuals over time, as histogram and as autocorrelation; say which, if not all."""
    M = shown.whitened.shape[2]
    size = np.array([_root_mean_square(shown.whitened[..., m]) for m in range(M)])
    order = np.argsort(-np.nan_to_num(size))[: SETTINGS.channels]
    words = (
        ""
        if M <= SETTINGS.channels
        else f"the {SETTINGS.channels} channels with the largest residuals of {M}"
    )
    with drawing():
        figure, axes = grid(len(order), 3, SETTINGS.width, 1.5, gap=0.55, width_ratios=(2.6, 1, 1))
        for row, m in enumerate(sorted(order)):
            _residual_row(axes[row], shown, int(m), float(size[m]))
            if row < len(order) - 1:
                continue
            for axis, label in zip(
                axes[row], ("time [s]", "standard deviations", "lag [samples]"), strict=True
            ):
                axis.set_xlabel(label)
        return svg(figure, f"{shown.title}: whitened residuals of {len(order)} channels"), words


def _root_mean_square(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def _residual_row(axes: Sequence[Any], shown: Residuals, m: int, size: float) -> None:
    series, histogram, correlation = axes
    values = shown.whitened[..., m]
    series.axhspan(-2, 2, color=FAINT, alpha=0.15, linewidth=0)
    order = np.argsort(shown.time_s.ravel(), kind="stable")
    series.plot(
        *envelope(shown.time_s.ravel()[order], values.ravel()[order]), color=CALIBRATED, linewidth=0.7
    )
    series.set_title(f"{shown.names[m]}: {size:.2f} times the noise")
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return
    limit = max(3.5, min(float(np.max(np.abs(finite))), 4 * size))
    bins = np.linspace(-limit, limit, 31)
    clipped = np.clip(finite, -limit, limit)
    histogram.hist(clipped, bins=bins, density=True, histtype="stepfilled", facecolor=CALIBRATED, alpha=0.5)
    x = np.linspace(-limit, limit, 101)
    histogram.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color=INK, linewidth=0.9)
    histogram.set_yticks([])
    rho, band = autocorrelation(values)
    correlation.axhspan(-band, band, color=FAINT, alpha=0.2, linewidth=0)
    correlation.vlines(np.arange(1, len(rho) + 1), 0, rho, color=CALIBRATED, linewidth=2)
    correlation.axhline(0, color=FAINT, linewidth=0.8)
    correlation.set_ylim(
        min(-0.4, float(rho.min(initial=0)) * 1.1), max(0.4, float(rho.max(initial=0)) * 1.1)
    )


def autocorrelation(values: FloatArray) -> tuple[FloatArray, float]:
    """Return the autocorrelation within windows at lags 1, 2, ... and the 95 % band of white noise.

    Args:
        values: Whitened residuals of one channel, (W, H).
    """
    clean = np.nan_to_num(values)
    power = float(np.mean(clean**2)) or 1.0
    lags = range(1, min(SETTINGS.lags, values.shape[1] - 1) + 1)
    rho = [float(np.mean(clean[:, lag:] * clean[:, :-lag]) / power) for lag in lags]
    return np.array(rho), 2.0 / float(np.sqrt(max(values.size, 1)))


def correlations(result: CalibrationResult) -> Markup | None:
    """Draw the correlation matrix of the estimates; None where there is no covariance."""
    if result.covariance is None or len(result.space) < 2:
        return None
    std = np.sqrt(np.diag(result.covariance))
    matrix = result.covariance / np.maximum(np.outer(std, std), 1e-300)
    K = len(std)
    side = float(np.clip(0.36 * K, 1.8, 6.6))
    longest = 0.075 * max(len(name) for name in result.space.names) + 0.15
    with drawing():
        figure, ((axis,),) = grid(1, 1, side + longest + 0.2, side + longest + 0.2)
        across = side / (side + longest + 0.2)
        axis.set_position((1 - across - 0.02, 0.02, across, across))
        for i in range(K):
            for j in range(K):
                _cell(axis, i, j, float(matrix[i, j]), K)
        axis.set_xlim(0, K)
        axis.set_ylim(K, 0)
        axis.xaxis.tick_top()
        axis.set_xticks(np.arange(K) + 0.5, result.space.names, rotation=90)
        axis.set_yticks(np.arange(K) + 0.5, result.space.names)
        axis.tick_params(length=0, labelsize=8 if K <= 24 else 6)
        axis.spines[:].set_visible(False)
        return svg(figure, f"correlations between {K} parameters")


def _cell(axis: Any, i: int, j: int, value: float, count: int) -> None:
    if abs(value) >= 0.05:
        colour = CALIBRATED if value > 0 else MINUS
        axis.add_patch(
            Rectangle(
                (j + 0.04, i + 0.04), 0.92, 0.92, facecolor=colour, alpha=min(abs(value), 1.0), linewidth=0
            )
        )
    if count <= SETTINGS.numbered and i != j and abs(value) >= 0.05:
        ink = PAPER if abs(value) > 0.6 else INK
        words = f"{value:.1f}".replace("0.", ".")
        axis.text(j + 0.5, i + 0.52, words, ha="center", va="center", fontsize=7, color=ink)


def latency_scan(scan: Mapping[str, Any], tick_s: float | None) -> Markup | None:
    """Draw the misfit of each whole tick of latency that was tried."""
    ticks, chi2 = np.array(scan.get("ticks", ())), np.array(scan.get("chi2", ()))
    if len(ticks) < 2 or len(ticks) != len(chi2):
        return None
    unit, label = (1e3 * tick_s, "latency [ms]") if tick_s else (1.0, "latency [device ticks]")
    with drawing():
        figure, ((axis,),) = grid(1, 1, 4.6, 2.3)
        axis.plot(ticks * unit, chi2, color=CALIBRATED, marker="o", markersize=4)
        best = int(np.argmin(chi2))
        axis.plot(ticks[best] * unit, chi2[best], color=INK, marker="o", markersize=7, fillstyle="none")
        if chi2.max() > 20 * max(chi2.min(), 1e-12):
            log_scale(axis)
        axis.set_xlabel(label)
        axis.set_title("misfit (chi-square) at each whole tick tried")
        axis.set_xticks(ticks * unit if len(ticks) <= 9 else ticks[::2] * unit)
        return svg(figure, "misfit over latency")


def trace(rows: Sequence[Mapping[str, float]]) -> Markup | None:
    """Draw what the search noted of each generation, one panel a quantity."""
    keys = list(dict.fromkeys(k for row in rows for k in row if k != "generation"))
    series = {k: np.array([row.get(k, np.nan) for row in rows], dtype=float) for k in keys}
    series = {k: v for k, v in series.items() if np.isfinite(v).sum() >= 2}
    if not series:
        return None
    columns = min(3, len(series))
    with drawing():
        figure, axes = grid(-(-len(series) // columns), columns, SETTINGS.width, 1.9, gap=0.8)
        for axis, (key, values) in zip(axes.ravel(), series.items(), strict=False):
            axis.plot(np.arange(1, len(values) + 1), values, color=CALIBRATED)
            finite = values[np.isfinite(values)]
            if finite.min() > 0 and finite.max() > 30 * finite.min():
                log_scale(axis)
            axis.set_title(key.replace("_", " "))
            axis.set_xlabel("generation")
            axis.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        for axis in axes.ravel()[len(series) :]:
            axis.set_visible(False)
        return svg(figure, f"search trace: {', '.join(series)}")


def population(
    space: ParameterSpace,
    members: FloatArray,
    estimate: FloatArray,
    told: np.ndarray[Any, np.dtype[np.bool_]],
) -> Markup:
    """Draw the last population inside the search range, one line a parameter, with the final estimate.

    Args:
        space: The parameters.
        members: Physical values, (N, K).
        estimate: Physical values, (K,).
        told: Which estimates to draw, (K,).
    """
    K = len(space)
    unit = np.clip(space.normalize(members), 0.0, 1.0)
    longest = 0.075 * max(len(name) for name in space.names) + 0.2
    height = 0.24 * K + 0.6
    with drawing():
        figure, ((axis,),) = grid(1, 1, SETTINGS.width * 0.75, height)
        axis.set_position(
            (
                longest / (SETTINGS.width * 0.75),
                0.5 / height,
                1 - (longest + 0.2) / (SETTINGS.width * 0.75),
                1 - 0.55 / height,
            )
        )
        for k in range(K):
            axis.plot(
                unit[:, k], np.full(len(unit), k), "|", color=CALIBRATED, markersize=9, markeredgewidth=0.8
            )
        axis.plot(space.normalize(estimate)[told], np.flatnonzero(told), "D", color=INK, markersize=3.5)
        axis.set_yticks(np.arange(K), space.names)
        axis.set_ylim(K - 0.5, -0.5)
        axis.set_xlim(-0.02, 1.02)
        axis.set_xticks([0, 0.25, 0.5, 0.75, 1], ["low", "", "midpoint of the range", "", "high"])
        axis.grid(axis="y", color=FAINT, alpha=0.25, linewidth=0.6)
        return svg(figure, f"last population of {len(unit)} members and estimate of {K} parameters")
