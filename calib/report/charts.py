"""The page's charts: series in their panels, the robot's drawing, and matrices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from deal_hw.calib.data.noise import autocorrelations
from deal_hw.calib.report.gather import OverlayPanel, ResidualOver, Residuals
from deal_hw.calib.report.panels import Panel, Series, envelope, nice_step
from deal_hw.calibration import CalibrationResult
from deal_hw.types import FloatArray
from deal_hw.viz.robot_drawing import Outline, RobotDrawing

MOST_CHANNELS = 8
"""Channels whose residuals are drawn: those with the largest."""

MOST_PANELS = 24
"""Channels whose motion is drawn: the first ones."""

MOST_POINTS = 90_000
"""Points of all motion on the page; long series are reduced to their lows and highs."""

LAGS = 20
"""Longest lag of autocorrelations [samples]."""

BINS = 30
"""Bins of histograms."""

LOG_RATIO = 20.0
"""Ratio of highest to lowest value above which positive series get a log scale."""

STRONG = 0.8
"""Least size of listed correlations."""

MOST_LISTED = 12
"""Most listed correlations."""

PICTURE_PX = 480
"""Width of the robot's drawing [pixels]."""


def overlay(shown: OverlayPanel, panels: int = MOST_PANELS) -> Markup:
    """Draw real, nominal and calibrated motion, one panel per channel.

    All overlays of the page share the limit of points over ``panels``, the number of their panels.
    """
    M = min(len(shown.names), MOST_PANELS)
    buckets = int(np.clip(MOST_POINTS / (6 * panels), 80, 1000))
    found = []
    for m in range(M):
        series = [
            Series(name=name, style=name, x=x, y=y)
            for name, values in (
                ("real", shown.real),
                ("nominal", shown.nominal),
                ("calibrated", shown.calibrated),
            )
            for x, y in [envelope(shown.time_s, values[:, m], buckets)]
        ]
        unit = shown.units[m]
        found.append(
            Panel(
                title=f"{shown.names[m]} [{unit}]",
                x_title="time [s]",
                series=series,
                x=_from_zero(*_wide(shown.time_s)),
                y=_frame(shown.real[:, m]),
                linked=True,
                label=f"{shown.title}: real, nominal and calibrated {shown.names[m]} [{unit}] over time [s]",
            )
        )
    return group(found, "alone" if M <= 2 else "")


def group(panels: Iterable[Panel], style: str = "") -> Markup:
    """Return panels side by side, as many as fit in the page's width; linked ones zoom together."""
    return Markup(f'<div class="panels {style}">{"".join(p.html() for p in panels)}</div>')


def _wide(values: FloatArray, least: float = 1e-9) -> tuple[float, float]:
    low, high = float(np.min(values, initial=np.inf)), float(np.max(values, initial=-np.inf))
    if not low <= high:
        return 0.0, 1.0
    return low, max(high, low + least)


def _from_zero(low: float, high: float) -> tuple[float, float]:
    """Return the ends of a time axis, from 0 if that is near."""
    return (0.0 if 0 < low < 0.05 * high else low), high


def _frame(real: FloatArray) -> tuple[float, float]:
    """Frame the measured motion: a diverging model must not shrink it."""
    low, high = _wide(real[np.isfinite(real)])
    margin = max(0.2 * (high - low), 1e-6 * abs(high), 1e-6)
    return low - margin, high + margin


def residuals(shown: Residuals) -> tuple[Markup, str]:
    """Draw whitened residuals over time, as histogram and as autocorrelation; name the selection, if any."""
    M = shown.whitened.shape[2]
    size = np.array([_root_mean_square(shown.whitened[..., m]) for m in range(M)])
    order = np.argsort(-np.nan_to_num(size))[:MOST_CHANNELS]
    words = "" if M <= MOST_CHANNELS else f"the {MOST_CHANNELS} channels with the largest residuals of {M}"
    rows = [group(_residual_row(shown, int(m), float(size[m])), "residual") for m in sorted(order)]
    return Markup("").join(rows), words


def spread(shown: Sequence[ResidualOver]) -> Markup:
    """Draw the size of residuals over the motion of their joints, one row for each channel."""
    largest: dict[str, float] = {}
    for one in shown:
        largest[one.channel] = max(largest.get(one.channel, 0.0), float(np.nanmax(one.size)))
    kept = sorted(largest, key=lambda name: -largest[name])[:MOST_CHANNELS]
    rows = []
    for channel in (name for name in largest if name in kept):
        panels = []
        for one in (one for one in shown if one.channel == channel):
            step = one.at[1] - one.at[0]
            unit = f" [{one.unit}]" if one.unit else ""
            panels.append(
                Panel(
                    title=f"{channel}, by {one.kind}",
                    x_title=f"{one.kind}{unit}",
                    series=[Series(name="residual", style="calibrated", kind="dots", x=one.at, y=one.size)],
                    x=(float(one.at[0] - step / 2), float(one.at[-1] + step / 2)),
                    y=(0.0, 1.08 * max(largest[channel], 2.0)),
                    bands=[(0.0, 1.0)],
                    label=f"{channel}: size of the residual [times the noise] over its {one.kind}{unit}",
                )
            )
        rows.append(group(panels, "motion"))
    return Markup("").join(rows)


def _root_mean_square(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def _residual_row(shown: Residuals, m: int, size: float) -> Iterator[Panel]:
    name, values = shown.names[m], shown.whitened[..., m]
    order = np.argsort(shown.time_s.ravel(), kind="stable")
    time, series = shown.time_s.ravel()[order], values.ravel()[order]
    # Stretches that are not fitted are gaps.
    step = np.diff(time)
    pauses = np.flatnonzero(step > 1.5 * np.median(step if len(step) else 0.0)) + 1
    time, series = envelope(np.insert(time, pauses, time[pauses]), np.insert(series, pauses, np.nan))
    finite = values[np.isfinite(values)]
    reach = float(np.max(np.abs(finite), initial=3.0))
    yield Panel(
        title=f"{name}: {size:.2f} times the noise" if len(finite) else f"{name}: no prediction",
        x_title="time [s]",
        series=[Series(name="residual", style="calibrated thin", x=time, y=series)],
        x=_from_zero(*_wide(shown.time_s)),
        y=(-1.05 * reach, 1.05 * reach),
        bands=[(-2, 2)],
        style="long",
    )
    if len(finite) == 0:
        return
    limit = max(3.5, min(reach, 4 * size))
    density, edges = np.histogram(np.clip(finite, -limit, limit), BINS, (-limit, limit), density=True)
    x = np.linspace(-limit, limit, 101)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    yield Panel(
        title="histogram",
        x_title="residual [times the noise]",
        series=[
            Series(
                name="histogram",
                style="calibrated",
                kind="area",
                x=np.repeat(edges, 2)[1:-1],
                y=np.repeat(density, 2),
            ),
            Series(name="unit normal", style="plain", x=x, y=normal),
        ],
        x=(-limit, limit),
        y=(0.0, 1.1 * max(float(density.max()), 0.4)),
        no_y=True,
    )
    rho, band = autocorrelation(values)
    low, high = min(-0.4, 1.1 * float(rho.min(initial=0))), max(0.4, 1.1 * float(rho.max(initial=0)))
    yield Panel(
        title="autocorrelation",
        x_title="lag [samples]",
        series=[
            Series(name="correlation", style="calibrated", kind="bars", x=np.arange(1.0, len(rho) + 1), y=rho)
        ],
        x=(0.0, len(rho) + 1.0),
        y=(low, high),
        bands=[(-band, band)],
        whole_x=True,
    )


def autocorrelation(values: FloatArray) -> tuple[FloatArray, float]:
    """Return the autocorrelation of a channel's residuals, (W, H), at lags 1, 2, ... and white noise's band.

    The band holds 95 %. A missing sample is NaN and does not count.
    """
    rho = [found for found, _ in autocorrelations([np.nan_to_num(values)], LAGS)]
    return np.array(rho), 2.0 / float(np.sqrt(max(np.isfinite(values).sum(), 1)))


def latency_scan(scan: Mapping[str, Any], tick_s: float | None) -> Markup | None:
    """Draw the misfit of each fitted whole tick of latency."""
    ticks, chi2 = np.array(scan.get("ticks", ()), dtype=float), np.array(scan.get("chi2", ()), dtype=float)
    if len(ticks) < 2 or len(ticks) != len(chi2):
        return None
    unit, label = (1e3 * tick_s, "latency [ms]") if tick_s else (1.0, "latency [device ticks]")
    series = Series(name="chi-square", style="calibrated", kind="dots", x=ticks * unit, y=chi2)
    return group([_positive("misfit (chi-square) at each whole tick tried", label, series, "half")], "alone")


def _positive(title: str, x_title: str, series: Series, style: str = "", *, whole: bool = False) -> Panel:
    """Return a panel of one series, on a log scale if its range is wide."""
    finite = series.y[np.isfinite(series.y)]
    low, high = float(finite.min()), float(finite.max())
    log_y = low > 0 and high > LOG_RATIO * low
    margin = max(0.08 * (high - low), 1e-6 * abs(high), 1e-12)
    y = (low / 1.3, 1.3 * high) if log_y else (low - margin, high + margin)
    left, right = _wide(series.x)
    # Dots at the ends are drawn whole.
    aside = 0.04 * (right - left) if series.kind == "dots" else 0.0
    return Panel(
        title=title,
        x_title=x_title,
        series=[series],
        x=(left - aside, right + aside),
        y=y,
        log_y=log_y,
        whole_x=whole,
        style=style,
    )


def trace(rows: Sequence[Mapping[str, float]]) -> Markup | None:
    """Draw the search's values of each generation, one panel per quantity."""
    keys = list(dict.fromkeys(k for row in rows for k in row if k != "generation"))
    found = []
    for key in keys:
        values = np.array([row.get(key, np.nan) for row in rows], dtype=float)
        if np.isfinite(values).sum() >= 2:
            number = np.arange(1.0, len(values) + 1)
            series = Series(name=key, style="calibrated", x=number, y=values)
            found.append(_positive(key.replace("_", " "), "generation", series, whole=True))
    return group(found, "small") if found else None


def ticks_in_range(unit: FloatArray) -> Markup:
    """Draw members of a population inside a search range, values from 0 to 1, (N,)."""
    places = np.unique(np.round(1000 * np.clip(unit, 0, 1)).astype(int))
    d = "".join(f"M{x} 0V10" for x in places)
    return Markup(
        '<svg viewBox="0 0 1000 10" preserveAspectRatio="none" aria-hidden="true">'
        f'<path class="rug" d="{d}"/></svg>'
    )


def correlation_matrix(result: CalibrationResult) -> FloatArray | None:
    """Return the estimates' correlations, (K, K); None where there is no covariance, or one parameter."""
    if result.covariance is None or len(result.space) < 2:
        return None
    std = np.sqrt(np.diag(result.covariance))
    return np.asarray(result.covariance / np.maximum(np.outer(std, std), 1e-300))


def correlations(matrix: FloatArray) -> Markup:
    """Draw correlations, (K, K): rows and columns are numbered as the parameters are."""
    K = len(matrix)
    cells: dict[tuple[str, int], list[str]] = {}
    marks = []
    for i, j in np.ndindex(K, K):
        value = float(np.nan_to_num(matrix[i, j]))
        level = round(10 * min(abs(value), 1.0))
        if not level:
            continue
        square = f"M{j}.03 {i}.03h.94v.94h-.94z"
        cells.setdefault(("plus" if value > 0 else "minus", level), []).append(square)
        if value < 0:
            # A sign beside the colour.
            marks.append(f"M{j}.3 {i}.5h.4")
    paths = "".join(
        f'<path class="{sign}" fill-opacity="{level / 10:g}" d="{"".join(squares)}"/>'
        for (sign, level), squares in cells.items()
    )
    numbers = "".join(
        f'<text x="{k + 0.5}" y="-.25">{k + 1}</text><text x="-.45" y="{k + 0.65}">{k + 1}</text>'
        for k in range(K)
    )
    return Markup(
        f'<svg class="matrix" viewBox="-1 -1 {K + 1} {K + 1}" style="max-width:{min(34 * (K + 1), 640)}px" '
        f'role="img" aria-label="correlations between {K} parameters">{paths}'
        f'<path class="sign" d="{"".join(marks)}"/>{numbers}</svg>'
    )


def strongest(matrix: FloatArray, names: Sequence[str]) -> list[tuple[str, str, float]]:
    """Return the pairs of parameters with the strongest correlations, strongest first."""
    i, j = np.triu_indices(len(matrix), 1)
    size = np.nan_to_num(np.abs(matrix[i, j]))
    order = [n for n in np.argsort(-size) if size[n] >= STRONG][:MOST_LISTED]
    return [(names[i[n]], names[j[n]], float(matrix[i[n], j[n]])) for n in order]


def robot(drawing: RobotDrawing) -> Markup:
    """Draw the robot as each predictor places it, with a scale bar."""
    left, bottom, width, height = drawing.box
    scale = PICTURE_PX / max(width, height)
    size = np.array([width, height]) * scale

    def path(outline: Outline, style: str) -> str:
        points = (
            np.column_stack([outline.points[:, 0] - left, bottom + height - outline.points[:, 1]]) * scale
        )
        d = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        return f'<path class="{style}" d="M{d}Z"><title>{escape(outline.name)}</title></path>'

    parts = [path(o, "fixed") for o in drawing.fixed]
    parts += [path(o, f"body {name}") for name, outlines in drawing.moving.items() for o in outlines]
    bar = nice_step(0.12 * max(width, height))
    words = f"{bar:g} m" if bar >= 0.1 else f"{1000 * bar:g} mm"
    y = size[1] - 6
    parts.append(f'<path class="scale" d="M6 {y:.1f}h{bar * scale:.1f}"/>')
    parts.append(f'<text x="{bar * scale + 12:.1f}" y="{y + 3:.1f}">{words}</text>')
    who = ", ".join(drawing.moving)
    return Markup(
        f'<svg class="robot" viewBox="0 0 {size[0]:.1f} {size[1]:.1f}" style="max-width:{size[0]:.0f}px" '
        f'role="img" aria-label="{escape(f"the robot: {who}; {drawing.caption}")}">{"".join(parts)}</svg>'
    )
