"""The page in a browser: it points and zooms, and a phone shows all of it; skipped without Chromium."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.calib.report.gather import OverlayPanel, ReportInputs, Residuals
from deal_hw.calib.report.page import render
from deal_hw.calibration import CalibrationResult
from deal_hw.findings import Finding
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


LONG = "a_rather_long_name_of_a_joint_without_any_place_to_break_it_" * 2
NARROW = """<script>
Object.assign(document.body.style, {width: "390px", margin: 0});
const right = (one) => one.getBoundingClientRect().right;
const past = [...document.body.querySelectorAll("*")].filter((one) => right(one) > 390.5);
const seen = {past: past.map((one) => `${one.tagName} ${one.className} ${one.textContent.slice(0, 40)}`)};
seen.shown = [...document.querySelectorAll(".parameters tbody tr")].map((row) => row.innerText);
seen.phone = matchMedia("(max-width: 44rem)").matches;
document.body.textContent = JSON.stringify(seen);
</script></body>"""


def motion(name: str) -> OverlayPanel:
    """Return two channels of 10 s: real is the time and its negative, nominal 2 above, calibrated 0.1."""
    time = np.linspace(0, 10, 1001)
    real = np.column_stack([time, -time])
    return OverlayPanel(
        title=f"{name}.csv", heldout=True, names=(name, "knee"), units=("rad", "rad"), time_s=time, real=real,
        nominal=real + 2, calibrated=np.where(time[:, None] < 6, real + 0.1, np.nan), window_s=0.2,
    )  # fmt: skip


def found(name: str, **changes: Any) -> CalibrationResult:
    """Return the result of one parameter."""
    space = ParameterSpace([Parameter.around(name, "body_mass", ("arm",), "kg", 1.0)])
    interval = np.array([[0.9, 1.1]])
    return CalibrationResult(method="eki", space=space, estimate=np.ones(1), interval=interval, **changes)


def act(inputs: ReportInputs, script: str, folder: Path) -> dict[str, Any]:
    """Return what a script finds on the page in a browser 500 pixels wide, its least."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    # The page's policy forbids the test's own script.
    html = re.sub(r"<meta http-equiv[^>]*>", "", render(inputs)).replace("</body>", script)
    page = folder / "page.html"
    page.write_text(html, encoding="utf-8")
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=500,900", "--dump-dom"]
    done = subprocess.run(
        [CHROMIUM, *options, f"--user-data-dir={folder}", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    body = re.findall(r"<body[^>]*>(.*)</body>", done.stdout, flags=re.DOTALL)[0]
    values: dict[str, Any] = json.loads(unescape(body))
    return values


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Point, drag and press keys on the first of two panels, and return what the page showed."""
    inputs = ReportInputs(robot="arm", result=found("mass"), overlays=(motion("hip"),))
    return act(inputs, ACT, tmp_path_factory.mktemp("page"))


def test_nothing_is_off_the_screen_of_a_phone(tmp_path: Path) -> None:
    """At 390 pixels every element ends inside, with names that have no place to break, and rows say all."""
    result = found(
        LONG,
        verdicts=("not identifiable",),
        null_directions=(f"{LONG} and {LONG}",),
        alarms=(Finding.alarm(LONG, LONG, LONG),),
        advice=({"parameter": LONG, "std": 1.0, "std_after": 0.5, "excitation": "x", "sentence": LONG},),
        heldout_nrmse={"nominal": 0.1, "calibrated": 0.02, "null": 0.3},
        covariance=np.eye(1),
        population=np.ones((3, 1)),
        trace=({LONG: 1.0}, {LONG: 2.0}),
        provenance={
            "dataset": LONG,
            "split_half": {
                "parameters": {LONG: {"first": [1, 0, 2], "second": [None, 0.1, 4], "agree": None}}
            },
            "heldout_rmse": {
                "window_s": 0.2,
                "unit": {LONG: "rad"},
                "mean": {"nominal": 0.1, "calibrated": 0.02},
                "by_coordinate": {"nominal": {LONG: 0.1}, "calibrated": {LONG: 0.02}},
                "noise": {"nrmse": 0.01, "mean": 0.01, "by_coordinate": {LONG: 0.01}},
            },
        },
    )
    whitened = np.random.default_rng(0).normal(size=(5, 20, 1))
    time = np.arange(100.0).reshape(5, 20)
    shown = Residuals(title=LONG, names=(LONG,), time_s=time, whitened=whitened)
    inputs = ReportInputs(
        robot=LONG,
        result=result,
        overlays=(motion(LONG),),
        residuals=(shown,),
        heldout=(LONG,),
        telemetry=(LONG,),
    )
    page = act(inputs, NARROW, tmp_path)
    assert page["phone"] and page["past"] == []
    (row,) = page["shown"]
    for words in (LONG, "nominal 1 kg", "no value", "90 % interval 0.9 … 1.1", "not identifiable"):
        assert words in row


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
