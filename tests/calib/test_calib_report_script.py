"""The page's script in a browser: it reads series back from the paths and zooms; skipped without Chromium."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

from deal_hw.calib.report.gather import OverlayPanel, ReportInputs
from deal_hw.calib.report.page import render
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import Parameter, ParameterSpace

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
ACT = """<script>
const plots = [...document.querySelectorAll("#overlays .plot")], plot = plots[0];
const box = plot.getBoundingClientRect(), at = (share) => ({clientX: box.left + share * box.width});
const point = (kind, share) => plot.dispatchEvent(new PointerEvent(kind, at(share)));
const press = (key) => plot.dispatchEvent(new KeyboardEvent("keydown", {key}));
const tip = () => plot.querySelector(".tip")?.innerText.split("\\n") ?? null;
const view = () => plots.map((one) => one.querySelector("svg").getAttribute("viewBox"));
plot.setPointerCapture = () => {};
const seen = {};
point("pointermove", 0.5); seen.tip = tip();
seen.crosses = plots.map((one) => one.querySelectorAll(".cross").length);
press("ArrowRight"); seen.right = tip()[0];
point("pointerleave", 0.5); seen.left = tip();
point("pointerdown", 0.25); point("pointermove", 0.5); point("pointerup", 0.5); seen.zoomed = view();
seen.ticks = [...plot.querySelectorAll(".xt")].map((one) => one.textContent);
point("pointermove", 0.5); seen.zoomed_tip = tip()[0];
press("-"); press("-"); press("-"); seen.out = view()[0];
press("+"); seen.closer = view()[0];
plot.dispatchEvent(new MouseEvent("dblclick")); seen.whole = view();
document.body.textContent = JSON.stringify(seen);
</script></body>"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Show two channels of 10 s to a browser, act on the first, and return what it showed."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    time = np.linspace(0, 10, 1001)
    real = np.column_stack([time, -time])
    shown = OverlayPanel(
        title="a.csv", heldout=True, names=("hip", "knee"), units=("rad", "rad"), time_s=time, real=real,
        nominal=real + 2, calibrated=np.where(time[:, None] < 6, real + 0.1, np.nan), window_s=0.2,
    )  # fmt: skip
    space = ParameterSpace([Parameter.around("mass", "body_mass", ("arm",), "kg", 1.0)])
    found = CalibrationResult(method="eki", space=space, estimate=np.ones(1), interval=np.array([[0.9, 1.1]]))
    html = render(ReportInputs(robot="arm", result=found, overlays=(shown,)))
    # The page's policy forbids the test's own script.
    html = re.sub(r"<meta http-equiv[^>]*>", "", html).replace("</body>", ACT)
    folder = tmp_path_factory.mktemp("page")
    page = folder / "page.html"
    page.write_text(html, encoding="utf-8")
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}", "--dump-dom"]
    done = subprocess.run(
        [CHROMIUM, *options, page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    body = re.findall(r"<body>(.*)</body>", done.stdout, flags=re.DOTALL)[0]
    values: dict[str, Any] = json.loads(body)
    return values


def test_pointing_shows_every_series_at_that_time(seen: dict[str, Any]) -> None:
    """At 5 s real is 5, nominal 7, calibrated 5.1 rad; the other panel shows where that is."""
    assert seen["tip"][0] == "time 5.00 s"
    values = [re.fullmatch(r"(\w+) ([\d.]+) rad", line) for line in seen["tip"][1:]]
    assert [v and v[1] for v in values] == ["real", "nominal", "calibrated"]
    assert [float(v[2]) for v in values if v] == pytest.approx([5, 7, 5.1], abs=0.02)
    assert seen["crosses"] == [1, 1] and seen["left"] is None


def test_dragging_and_keys_zoom_all_panels_of_a_recording(seen: dict[str, Any]) -> None:
    """From a quarter to the half: 2.5 to 5 s of 10; keys move and zoom; a double click shows all again."""
    assert seen["zoomed"] == ["2000 0 2000 2000"] * 2
    assert seen["ticks"] == ["2.5", "3.0", "3.5", "4.0", "4.5", "5.0"]
    assert seen["zoomed_tip"] == "time 3.75 s" and seen["right"] == "time 5.10 s"
    assert seen["out"] == "0 0 8000 2000" and float(seen["closer"].split()[2]) == 4000
    assert seen["whole"] == ["0 0 8000 2000"] * 2
