"""Panels: where values come to lie, ticks, and whether everybody can tell the colours apart."""

from __future__ import annotations

import itertools
import re
from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.calib.report.panels import HEIGHT, WIDTH, Panel, Series, nice_step, ticks_of
from deal_hw.types import FloatArray

SHEET = resources.files("deal_hw.calib.report").joinpath("report.css").read_text(encoding="utf-8")


def panel(drawn: list[float], **changes: object) -> str:
    """Return a panel of one series over x = 0, 1, 2, ..., y from 0 to 10."""
    series = Series(name="real", style="real", x=np.arange(float(len(drawn))), y=np.array(drawn))
    values: dict[str, object] = {
        "title": "hip [rad]",
        "x_title": "time [s]",
        "series": [series],
        "x": (0.0, 4.0),
        "y": (0.0, 10.0),
    }
    return str(Panel(**{**values, **changes}).html())  # type: ignore[arg-type]


def path(html: str) -> str:
    """Return the geometry of the series."""
    return str(re.findall(r'data-name="real" d="([^"]*)"', html)[0])


def test_values_lie_where_the_axes_put_them() -> None:
    """0 is at the bottom, 10 at the top; a gap begins anew, a lone sample is a dot, far outside is cut."""
    assert (WIDTH, HEIGHT) == (8000, 2000)
    assert path(panel([0, 10, 5])) == "M0 2000L2000 0L4000 1000"
    assert path(panel([0, 10, np.nan, 5])) == "M0 2000L2000 0M6000 1000h0"
    assert path(panel([1e9, -1e9])) == "M0 -2000L2000 4000"
    assert path(panel([np.nan, np.nan])) == ""


def test_a_log_panel_puts_decades_at_equal_steps() -> None:
    """From 0.1 to 1000: 1 is a quarter up; what is not above 0 is a gap."""
    html = panel([1, 1000, 0, 0.1], y=(0.1, 1000.0), log_y=True)
    assert path(html) == "M0 1500L2000 0M6000 2000h0"
    assert re.findall(r'class="yt"[^>]*>([^<]*)<', html) == ["0.1", "1", "10", "100", "1000"]


def test_axes_say_what_they_are_and_where() -> None:
    """Title and unit, ticks at both axes, the words of the other axis; a user's name is escaped."""
    html = panel([0, 1], title="<hip> [rad]")
    assert "&lt;hip&gt; [rad]" in html and "<hip>" not in html and "time [s]" in html
    assert re.findall(r'class="xt" style="left:([\d.]+)%">([^<]*)<', html) == [
        ("0.00", "0"), ("25.00", "1"), ("50.00", "2"), ("75.00", "3"), ("100.00", "4"),
    ]  # fmt: skip
    assert re.findall(r'class="yt"[^>]*>([^<]*)<', html) == ["0", "2", "4", "6", "8", "10"]


@given(st.floats(-1e4, 1e4), st.floats(1e-4, 1e4), st.integers(3, 8))
def test_ticks_are_few_round_and_between_the_ends(low: float, span: float, most: int) -> None:
    """At most one more than asked for, equally far apart; each word reads as its value."""
    found = ticks_of(low, low + span, most)
    values = [value for value, _ in found]
    step = nice_step(span / most)
    slack = 1e-6 * step
    assert 1 <= len(found) <= most + 1
    assert all(low - slack <= value <= low + span + slack for value in values)
    assert np.abs(np.diff(values, 2)).max(initial=0.0) < 1e-3 * step
    for value, word in found:
        assert float(word.replace("−", "-")) == pytest.approx(value, rel=0, abs=0.1 * step)


def test_whole_ticks_are_whole() -> None:
    """Generations 1 to 3 have no tick between them."""
    assert [word for _, word in ticks_of(1, 3, 6, whole=True)] == ["1", "2", "3"]


def colours(sheet: str) -> dict[str, FloatArray]:
    """Return the variables of a part of the style sheet as red, green, blue from 0 to 1."""
    found = re.findall(r"--([a-z]+): #([0-9a-f]{6})", sheet)
    return {name: np.array([int(code[k : k + 2], 16) for k in (0, 2, 4)]) / 255 for name, code in found}


LIGHT = colours(SHEET[: SHEET.index("@media screen")])
DARK = colours(SHEET[SHEET.index("@media screen") : SHEET.index("* {")])


def linear(colour: FloatArray) -> FloatArray:
    """Return light from a colour as screens have it (IEC 61966-2-1)."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def contrast(one: FloatArray, other: FloatArray) -> float:
    """Return the contrast ratio of WCAG 2: from 1 to 21."""
    bright = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, other))
    return (bright[1] + 0.05) / (bright[0] + 0.05)


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
def test_text_and_lines_have_contrast(theme: dict[str, FloatArray]) -> None:
    """WCAG AA: 4.5 to 1 for words, 3 to 1 for what is drawn."""
    assert set(theme) == set(LIGHT)
    for ground in ("paper", "panel"):
        for word in ("ink", "soft", "good", "open", "bad", "calibrated"):
            assert contrast(theme[word], theme[ground]) >= 4.5, (word, ground)
    for line in ("real", "nominal", "calibrated", "faint"):
        assert contrast(theme[line], theme["paper"]) >= 3.0, line


DEFICIENT = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
"""What is left of linear light without one kind of cone (Machado et al. 2009, severity 1)."""


def lab(light: FloatArray) -> FloatArray:
    """Return CIELAB coordinates of linear sRGB light."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    ratio = to_xyz @ np.clip(light, 0, 1) / (to_xyz @ np.ones(3))
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=["light", "dark"])
@pytest.mark.parametrize("matrix", [np.eye(3), *map(np.array, DEFICIENT.values())], ids=["full", *DEFICIENT])
def test_series_are_told_apart_with_any_colour_vision(
    theme: dict[str, FloatArray], matrix: FloatArray
) -> None:
    """Real, nominal and calibrated differ by 20 in CIELAB; 2 is just seen."""
    seen = [lab(matrix @ linear(theme[name])) for name in ("real", "nominal", "calibrated")]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 20


def test_series_differ_in_more_than_colour() -> None:
    """Wide, dashed and thin: on paper without colour they are still three."""
    style = {
        name: re.findall(rf"\.plot \.{name} {{([^}}]*)}}", SHEET)[0]
        for name in ("real", "nominal", "calibrated")
    }
    assert "dasharray" in style["nominal"] and "dasharray" not in style["real"] + style["calibrated"]
    width = {name: float(re.findall(r"stroke-width: ([\d.]+)", text)[0]) for name, text in style.items()}
    assert width["real"] > 2 * width["calibrated"]
