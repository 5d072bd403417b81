"""The report: one file that needs nothing, escapes everything, and says what the result says."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.calib.report.charts import autocorrelation, correlations, strongest
from deal_hw.calib.report.gather import OverlayPanel, ReportInputs, Residuals, gather
from deal_hw.calib.report.page import (
    heldout_rows,
    parameter_rows,
    render,
    script_digest,
    write_report,
    write_result,
)
from deal_hw.calib.report.panels import envelope
from deal_hw.calib.report.verdict import trust
from deal_hw.calibration import CalibrationResult, read_result
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.sim.recordings.parts import part, stretches
from deal_hw.viz.robot_drawing import Outline, RobotDrawing

HOSTILE = "<script>alert('x')</script>&$a_b$ --> \" </svg>"


def space(count: int = 2, name: str = "p") -> ParameterSpace:
    """Return parameters on a log range from 1 to 100."""
    return ParameterSpace(
        Parameter(name=f"{name}{k}", kind="k", elements=("e",), unit="kg", nominal=10, low=1, high=100)
        for k in range(count)
    )


def result(searched: ParameterSpace, **changes: Any) -> CalibrationResult:
    """Return a result at the midpoint of its range."""
    K = len(searched)
    values = {
        "method": "eki",
        "estimate": np.full(K, 10.0),
        "interval": np.tile([5.0, 20.0], (K, 1)),
        "covariance": np.eye(K) * 0.01,
        "population": np.full((5, K), 12.0),
        "verdicts": ("identifiable",) * K,
        "latency_s": 0.012,
        "latency_interval_s": (0.011, 0.013),
        "chi2": 1.05,
        "heldout_nrmse": {"nominal": 0.1, "calibrated": 0.02, "null": 0.3},
        "trace": tuple({"generation": float(i), "misfit": 10.0 / (i + 1)} for i in range(6)),
        "steps": 1000,
        "seconds": 1.5,
        "provenance": {"latency_scan": {"ticks": [11, 12, 13], "chi2": [2.0, 1.05, 1.9]}, "seed": 3},
    }
    return CalibrationResult(space=searched, **{**values, **changes})


def inputs(found: CalibrationResult, channels: int = 2, samples: int = 200, name: str = "q") -> ReportInputs:
    """Return what a report shows, with series of noise."""
    rng = np.random.default_rng(0)
    names = tuple(f"{name}{m}" for m in range(channels))
    real = rng.normal(size=(samples, channels))
    overlays = tuple(
        OverlayPanel(
            title=f"{name} {heldout}",
            heldout=heldout,
            names=names,
            units=("rad",) * channels,
            time_s=np.arange(samples, dtype=np.float64) * 0.01,
            real=real,
            nominal=real + 1,
            calibrated=real,
            window_s=0.2,
        )
        for heldout in (False, True)
    )
    whitened = rng.normal(size=(samples // 20, 20, channels))
    time = np.arange(samples, dtype=np.float64).reshape(-1, 20) * 0.01
    residuals = (Residuals(title=name, names=names, time_s=time, whitened=whitened),)
    return ReportInputs(robot=name, result=found, overlays=overlays, residuals=residuals, tick_s=1e-3)


class Tags(HTMLParser):
    """Collects the tags, the attributes and the words of a page; its style sheet and script are no words."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note one tag."""
        self.tags.append(tag)
        self._inside = tag
        self.attributes.extend((k, v or "") for k, v in attrs)

    def handle_data(self, data: str) -> None:
        """Note what is read, and what is run."""
        {"script": self.scripts, "style": []}.get(self._inside, self.words).append(data)

    def handle_endtag(self, tag: str) -> None:
        """What follows is read."""
        self._inside = ""

    def text(self) -> str:
        """Return what is read, one blank between words."""
        return " ".join(" ".join(self.words).split())


def test_page_loads_nothing_from_elsewhere() -> None:
    """No address, image or style sheet: references stay inside, a policy forbids all but its own script."""
    text = render(inputs(result(space())))
    page = Tags(text)
    assert "http:" not in text and "https:" not in text and "@import" not in text and "url(" not in text
    assert not {"img", "link", "iframe", "object"} & set(page.tags)
    (script,) = page.scripts
    assert page.tags.count("script") == 1 and not any(k.startswith("on") for k, _ in page.attributes)
    (policy,) = [v for k, v in page.attributes if k == "content" and "-src" in v]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert policy == allowed and script_digest(script.removeprefix("\n")) == f"sha256-{digest}"
    references = [v for k, v in page.attributes if k in ("href", "xlink:href", "src")]
    assert references and all(v.startswith("#") for v in references)
    identities = [v for k, v in page.attributes if k == "id"]
    assert {v.removeprefix("#") for v in references} <= set(identities)


def test_names_of_the_user_are_escaped_everywhere() -> None:
    """A hostile parameter, channel, robot, alarm and path is shown as written, and is no markup."""
    searched = space(3, HOSTILE)
    found = result(
        searched,
        method=HOSTILE,
        alarms=(Finding.alarm(HOSTILE, HOSTILE, HOSTILE),),
        null_directions=(HOSTILE,),
        trace=({HOSTILE: 1.0}, {HOSTILE: 2.0}),
        provenance={
            "dataset": HOSTILE,
            HOSTILE: {HOSTILE: HOSTILE},
            "settings": {HOSTILE: HOSTILE},
            "split_half": {
                "parameters": {HOSTILE: {"first": [1, 0, 2], "second": [3, 2.5, 4], "agree": False}}
            },
        },
    )
    given_ = dataclasses.replace(
        inputs(found, name=HOSTILE),
        telemetry=(HOSTILE,),
        left_out=(HOSTILE,),
        heldout=(HOSTILE,),
        drawing=drawing(HOSTILE),
    )
    page = Tags(render(given_))
    assert page.tags.count("script") == 1 and "alert" not in page.scripts[0]
    assert sum(HOSTILE in words for words in page.words) >= 16
    # The robot, 4 panels of motion, 6 of residuals, 1 of correlations, 1 of the search, 3 of the population.
    assert page.tags.count("svg") == 16


def drawing(name: str = "now") -> RobotDrawing:
    """Return the drawing of a robot that is a triangle."""
    triangle = Outline(name=name, points=np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return RobotDrawing(caption=name, box=(0, 0, 1, 1), fixed=(), moving={"real": (triangle,)})


def test_the_story_comes_first_then_the_verdict_then_alarms() -> None:
    """Result, bars and robot; whether it can be used; alarms in three parts; parameters; then the charts."""
    found = result(space(), alarms=(Finding.alarm("the rail is bent by 2 mm", "friction", "buy one"),))
    page = Tags(render(dataclasses.replace(inputs(found), drawing=drawing("after 0.2 s"))))
    order = (
        "5.0 times better than the nominal model",
        "nominal model: 10 %",
        "calibrated model: 2 %",
        "after 0.2 s",
        "Can it be used?",
        "! Amber.",
        "Read it before you use the result",
        "1 alarm",
        "seen the rail is bent by 2 mm it means friction to do buy one",
        "90 % interval",
        "Held-out error",
        "Real, nominal and calibrated motion",
        "Residuals of the calibrated model",
        "Provenance",
    )
    text, at = page.text(), -1
    for words in order:
        at = text.index(words, at + 1)


def test_alarms_with_one_remedy_are_one_entry() -> None:
    """Three alarms, two of them with the same remedy and meaning: two entries, each remedy once."""
    alarms = (
        Finding.alarm("a jitters", "worn out", "buy one"),
        Finding.alarm("b sticks", "rust", "oil it"),
        Finding.alarm("c jitters", "worn out", "buy one"),
    )
    text = Tags(render(inputs(result(space(), alarms=alarms)))).text()
    assert "3 alarms" in text
    at = [text.index(words) for words in ("a jitters", "c jitters", "buy one", "b sticks", "oil it")]
    assert at == sorted(at)
    assert text.count("buy one") == 1 and text.count("worn out") == 1


def test_values_that_a_named_cause_moves_are_marked() -> None:
    """In the row of the parameter and beside the latency, with the cause; nowhere else."""
    plain, biased = (
        Tags(render(inputs(result(space(), biased=causes)))).text()
        for causes in ({}, {"p1": "damping", "latency": "delay"})
    )
    assert "biased by" not in plain
    assert biased.count("biased by damping") == 1 and biased.count("biased by delay") == 1


def test_every_panel_names_recording_unit_and_lines() -> None:
    """Titles are files; axes have units and ticks; a legend names what is drawn before the first panel."""
    found = inputs(result(space()))
    overlays = [
        dataclasses.replace(shown, title=title)
        for shown, title in zip(found.overlays, ("fit.csv, 0 to 2 s", "000003.mcap"), strict=True)
    ]
    html = render(
        dataclasses.replace(found, overlays=tuple(overlays), heldout=("000003.mcap",), heldout_s=2.0)
    )
    text = Tags(html).text()
    assert "fit.csv, 0 to 2 s fitted; restarts every 0.2 s" in text
    assert "000003.mcap held out: not used in the fit; restarts every 0.2 s" in text
    assert "Held out: 000003.mcap; 2 s." in text
    assert text.index("real robot nominal model calibrated model") < text.index("fit.csv, 0 to 2 s")
    panels = html.split('<figure class="panel ')[1:]
    assert len(panels) == 4 + 6 + 1 + 1
    for one in panels:
        assert one.count('class="xt"') >= 2 and 'class="xtitle">' in one
        assert one.count('class="yt"') >= 2 or "<figcaption>histogram" in one
    for one in panels[:4]:
        assert re.search(r"<figcaption>q[01] \[rad\]<", one) and 'class="xtitle">time [s]<' in one
        assert re.findall(r'data-name="(\w+)"', one) == ["real", "nominal", "calibrated"]


def test_correlations_are_drawn_with_a_sign_and_the_strongest_are_named() -> None:
    """Both signs differ in more than colour; correlations near 0 are left out."""
    matrix = np.array([[1.0, -0.9, 0.02], [-0.9, 1.0, 0.85], [0.02, 0.85, 1.0]])
    drawn = correlations(matrix)
    squares = {sign: d.count("z") for sign, d in re.findall(r'class="(plus|minus)".*?d="([^"]*)"', drawn)}
    assert squares["minus"] == 2 and len(re.findall(r"M\d\.3 ", drawn)) == 2
    assert sum(d.count("z") for d in re.findall(r'd="([^"]*)"', drawn)) == 3 + 2 + 2
    assert strongest(matrix, ("a", "b", "c")) == [("a", "b", -0.9), ("b", "c", 0.85)]


def test_a_half_that_tells_nothing_has_no_value() -> None:
    """No estimate stands beside an interval that does not hold it."""
    rows = {
        "a": {"first": [2, 1, 3], "second": [None, 5, 95], "agree": None},
        "b": {"first": [2, 1, 3], "second": [2.5, 2, 3], "agree": True},
        "c": {"first": [2, 1, 3], "second": [7, 6, 8], "agree": False},
    }
    text = Tags(render(inputs(result(space(), provenance={"split_half": {"parameters": rows}})))).text()
    assert "a first half 2 (1 … 3) second half no value (5 … 95) not identified by a half" in text
    assert "second half 2.5 (2 … 3) agree" in text
    assert "second half 7 (6 … 8) disagree: intervals do not overlap" in text


def test_an_estimate_outside_its_interval_is_said_to_be() -> None:
    """An interval of 5 to 20 does not hold 30."""
    found = result(space(2), estimate=np.array([10.0, 30.0]))
    assert [row.outside for row in parameter_rows(found)] == [False, True]
    assert Tags(render(inputs(found))).text().count("outside its interval") == 1


HELD = {"nominal": 0.06, "calibrated": 0.01, "null": 0.2}


@pytest.mark.parametrize(
    ("changes", "colour", "words"),
    [
        ({}, "green", "6.0 times smaller"),
        # 2 % worse than nominal is chance, more is not; what is not a number is worse, too.
        ({"heldout_nrmse": {**HELD, "calibrated": 0.0611}}, "green", "6.1 % of the signal's range, as yours"),
        ({"heldout_nrmse": {**HELD, "calibrated": 0.0589}, "chi2": 4.0}, "red", "no better than yours"),
        ({"heldout_nrmse": {**HELD, "calibrated": 0.0588}, "chi2": 4.0}, "amber", "better than yours"),
        ({"heldout_nrmse": {**HELD, "calibrated": 0.0613}}, "red", "6.1 % of the signal's range"),
        ({"heldout_nrmse": {**HELD, "calibrated": float("nan")}}, "red", "model is worse"),
        ({"heldout_nrmse": {**HELD, "calibrated": 0.07}, "chi2": 4.0}, "red", "model is worse"),
        ({"chi2": 4.0}, "amber", "2.0 times the sensor's noise"),
        (
            {"chi2": 4.0, "provenance": {"diagnosis": [{}]}},
            "amber",
            "The first alarm names the likely cause.",
        ),
        ({"chi2": 4.0, "heldout_nrmse": {}}, "red", "no held-out recording shows"),
        ({"chi2": float("nan")}, "amber", "does not test"),
        ({"null_directions": ("a and b",)}, "amber", "hardly tell some parameters apart"),
        ({"verdicts": ("not identifiable",) * 2}, "amber", "do not identify all parameters"),
        ({"alarms": (Finding.alarm("x", "y", "z"),)}, "amber", "There is 1 alarm."),
        ({"heldout_nrmse": {}}, "amber", "no held-out recording"),
    ],
)
def test_verdict_asks_held_out_motion_first(changes: dict[str, Any], colour: str, words: str) -> None:
    """Worse than the user's own model is red whatever else; chi2 4 is twice the noise."""
    found = trust(result(space(), **{"heldout_nrmse": HELD, **changes}))
    assert found.colour == colour and words in found.sentence


@pytest.mark.parametrize(
    ("noise", "heldout", "colour", "words"),
    [
        (0.001, HELD, "red", "6.0 times that of the sensor's noise. Many values"),
        (0.004, HELD, "amber", "does not test"),
        (None, HELD, "red", "0.6 % of the range. Many values"),
        (0.001, {}, "red", "no held-out recording tests its values"),
    ],
)
def test_values_from_distributions_are_red_unless_they_predict_as_noise(
    noise: float | None, heldout: dict[str, float], colour: str, words: str
) -> None:
    """An error of 0.006 of the range is 6 times a noise of 0.001: not worth deploying."""
    provenance: dict[str, Any] = {"compares": "distributions", "heldout_rmse": {}}
    if noise is not None:
        provenance["heldout_rmse"] = {"noise": {"nrmse": noise}}
    calibrated = {**heldout, "calibrated": 0.006} if heldout else {}
    found = trust(result(space(), heldout_nrmse=calibrated, chi2=float("nan"), provenance=provenance))
    assert found.colour == colour and words in found.sentence


def test_bars_lie_where_the_search_scale_puts_them() -> None:
    """Log range from 1 to 100: 10 is the middle; 5 to 20 begins at ln 5 / ln 100 = 34.9 %, 30.1 % wide."""
    row = parameter_rows(result(space(1)))[0]
    assert row.estimate_at == pytest.approx(50) and row.nominal_at == pytest.approx(50)
    assert row.bar_left == pytest.approx(34.95, abs=0.01) and row.bar_width == pytest.approx(30.10, abs=0.01)
    assert row.at_bound == ""


def test_parameter_at_the_end_of_its_range_is_marked() -> None:
    """An estimate of 100 in a range up to 100 ended at its upper bound."""
    found = result(space(1), estimate=np.array([100.0]))
    assert parameter_rows(found)[0].at_bound == "upper"
    assert "ended at its upper bound" in render(inputs(found))


def test_what_the_data_cannot_tell_gets_no_value() -> None:
    """A parameter that is not identifiable has an interval and no estimate on the page."""
    found = result(space(2), estimate=np.array([11.3, 13.7]), verdicts=("identifiable", "not identifiable"))
    text = Tags(render(dataclasses.replace(inputs(found), overlays=(), residuals=()))).text()
    assert "estimate 11.3" in text and "13.7" not in text and "no value" in text


def test_an_open_parameter_is_named_without_a_direction() -> None:
    """The page does not say "Nothing" beside a parameter without a value."""
    text = Tags(render(inputs(result(space(), verdicts=("identifiable", "not identifiable"))))).text()
    assert "p1: not identifiable. Nearly the whole range" in text and "Nothing: every" not in text


def test_a_bare_result_makes_a_page_too() -> None:
    """Without covariance, population, verdicts, scan and recordings there are words in their place."""
    found = result(
        space(),
        covariance=None,
        population=None,
        verdicts=(),
        trace=(),
        provenance={},
        heldout_nrmse={},
        chi2=float("nan"),
    )
    text = render(ReportInputs(robot="r", result=found))
    assert (
        "No recording was given" in text
        and "The method does not compute them" in text
        and "It is not known how well" in text
        and text.count("--holdout") == 1
    )


def test_large_robot_stays_below_the_limit(tmp_path: Path) -> None:
    """24 parameters, 36 channels and 8000 samples in two recordings stay below 3 MB."""
    found = result(space(24))
    write_report(tmp_path, inputs(found, channels=36, samples=8000))
    size = (tmp_path / "report.html").stat().st_size
    assert 100_000 < size < 3_000_000
    assert "The first 24 of 36 channels" in (tmp_path / "report.html").read_text()


@given(
    st.lists(st.one_of(st.floats(-1e3, 1e3), st.just(float("nan"))), min_size=1, max_size=300),
    st.integers(2, 20),
)
def test_thinning_keeps_extremes_and_gaps(values: list[float], buckets: int) -> None:
    """Whatever the series: at most three points a bucket, in order, with the lowest and the highest."""
    y = np.array(values)
    time, thin = envelope(np.arange(len(y), dtype=float), y, buckets)
    assert len(thin) <= max(3 * buckets, 2 * buckets) and np.all(np.diff(time) > 0)
    assert bool(np.isnan(thin).any()) == bool(np.isnan(y).any())
    if np.isfinite(y).any():
        assert np.nanmin(thin) == np.nanmin(y) and np.nanmax(thin) == np.nanmax(y)


def test_autocorrelation_of_an_alternating_series() -> None:
    """+1, -1, +1, ... has -1 at odd lags and +1 at even ones; 2 windows of 10 give a band of 2 / sqrt(20)."""
    rho, band = autocorrelation(np.tile([1.0, -1.0], (2, 5)))
    assert rho[:4].tolist() == [-1, 1, -1, 1] and band == pytest.approx(0.4472, abs=1e-4)


def test_missing_samples_do_not_whiten_residuals() -> None:
    """A moving sum of two has a correlation of 0.5 at lag 1, also with 40 % of the samples lost."""
    white = np.random.default_rng(0).standard_normal((40, 201))
    lost = np.random.default_rng(1).random((40, 200)) < 0.4
    rho, band = autocorrelation(np.where(lost, np.nan, white[:, 1:] + white[:, :-1]))
    assert rho[0] == pytest.approx(0.5, abs=0.03) and abs(rho[1]) < 0.05
    assert band == pytest.approx(2 / np.sqrt(np.sum(~lost)))


def test_held_out_error_of_each_joint_stands_in_its_unit() -> None:
    """A row for each joint and their mean, a column for each predictor; what diverged says so."""
    rmse: dict[str, Any] = {
        "window_s": 5.0,
        "unit": {"hip": "rad", "knee": "rad"},
        "mean": {"nominal": None, "calibrated": 0.02},
        "by_coordinate": {"nominal": {"hip": 0.5, "knee": None}, "calibrated": {"hip": 0.01, "knee": 0.03}},
    }
    names, rows = heldout_rows(rmse)
    assert names == ["nominal", "calibrated"]
    assert rows == [
        ("hip", "rad", [0.5, 0.01]),
        ("knee", "rad", [None, 0.03]),
        ("mean", "rad", [None, 0.02]),
    ]
    found = result(space(), heldout_nrmse=HELD, provenance={"heldout_rmse": rmse})
    text = Tags(render(inputs(found))).text()
    assert "restart every 5 s" in text and "by_coordinate" not in text
    assert "knee [rad] nominal diverged calibrated 0.03 mean [rad] nominal diverged calibrated 0.02" in text
    # A mean over rad and m is no quantity; the sensor's noise is a column where it is known.
    noise = {"nrmse": 0.01, "mean": 0.2, "by_coordinate": {"hip": 0.1, "knee": 0.3}}
    names, rows = heldout_rows({**rmse, "unit": {"hip": "rad", "knee": "m"}, "noise": noise})
    assert names[-1] == "noise"
    assert rows == [("hip", "rad", [0.5, 0.01, 0.1]), ("knee", "m", [None, 0.03, 0.3])]
    assert heldout_rows({}) == ([], [])


@pytest.fixture(scope="module")
def recordings() -> tuple[RobotModel, CalibrationResult, list[SampledEpisode]]:
    """A cart-pole with 7 ms latency and sensor noise, twice 2.5 s, and a result with its true parameters."""
    robot, searched = load_model(DESCRIPTION), k9_space().with_ratio(3.0)
    truth = searched.unnormalize(np.linspace(0.3, 0.7, len(searched)))
    episodes = [
        align(
            simulated_episode(
                DESCRIPTION, searched, truth, seconds=2.5, latency_ticks=7, sensor=True, seed=seed
            ),
            DESCRIPTION,
        )
        for seed in (1, 2)
    ]
    K = len(searched)
    found = CalibrationResult(
        method="truth",
        space=searched,
        estimate=truth,
        interval=np.stack([truth, truth], axis=1),
        covariance=np.eye(K) * 1e-4,
        latency_s=0.007,
        latency_interval_s=(0.007, 0.007),
    )
    return robot, found, episodes


@pytest.fixture(scope="module")
def gathered(recordings: tuple[RobotModel, CalibrationResult, list[SampledEpisode]]) -> ReportInputs:
    """Gather at the true parameters."""
    robot, found, episodes = recordings
    return gather(robot, found, episodes[:1], episodes[1:], telemetry=["fine"], threads=1)


def test_overlays_restart_as_often_as_held_out_predictions(
    recordings: tuple[RobotModel, CalibrationResult, list[SampledEpisode]],
) -> None:
    """1 s is drawn as 1 s; a recording of half a second beside one of 2.5 s gets what it holds."""
    robot, found, episodes = recordings
    short = part(episodes[0], 0, round(0.5 / episodes[0].period_s) + 1)
    drawn = gather(robot, found, [episodes[0], short], episodes[1:], window_s=1.0, threads=1).overlays
    assert [shown.window_s for shown in drawn] == pytest.approx([1.0, 1.0, 0.45], abs=0.06)
    text = Tags(render(ReportInputs(robot="r", result=found, overlays=drawn))).text()
    assert text.count("fitted; restarts every 1 s") == 1 and "not used in the fit; restarts every 1 s" in text


def test_recordings_are_called_by_their_files(
    recordings: tuple[RobotModel, CalibrationResult, list[SampledEpisode]],
) -> None:
    """Where parts of one file are shown, each says from when to when; time counts from the file's start."""
    robot, found, episodes = recordings
    first, second = (dataclasses.replace(e, name=f"{n}.csv") for e, n in zip(episodes, "ab", strict=True))
    half = part(first, len(first.sample) // 2, len(first.sample))
    shown = gather(robot, found, [first, half], [second], threads=1)
    between = f"{half.time_s[0]:.4g} to {half.time_s[-1]:.4g} s"
    assert [one.title for one in shown.overlays][::2] == ["b.csv", f"a.csv, {between}"]
    assert shown.overlays[2].time_s[0] == pytest.approx(1.25, abs=0.05)
    assert [one.title for one in shown.residuals] == [one.title for one in shown.overlays[1:]]
    # Stretches that follow each other are shown as the one recording that they were.
    whole = gather(robot, found, stretches(first, 1.0), [second], threads=1).overlays[1]
    assert whole.title == "a.csv" and len(whole.time_s) == len(first.sample)
    assert shown.heldout == ("b.csv",) and shown.heldout_s == pytest.approx(2.5, abs=0.1)
    # Real and calibrated are drawn on each other, the nominal model beside them.
    assert shown.drawing is not None and "b.csv at" in shown.drawing.caption
    places = {name: outlines[0].points.mean(axis=0) for name, outlines in shown.drawing.moving.items()}
    off = {name: np.linalg.norm(place - places["real"]) for name, place in places.items()}
    assert off["calibrated"] < 0.1 * off["nominal"]


def test_gathered_series_show_what_the_models_predict(gathered: ReportInputs) -> None:
    """The true parameters predict both recordings better than the nominal ones, in every channel."""
    assert [shown.heldout for shown in gathered.overlays] == [True, False]
    for shown in gathered.overlays:
        assert shown.names == ("cart", "pole") and shown.units == ("m", "rad")
        assert shown.real.shape == shown.nominal.shape == shown.calibrated.shape == (len(shown.time_s), 2)
        error = [
            np.sqrt(np.nanmean((m - shown.real) ** 2, axis=0)) for m in (shown.nominal, shown.calibrated)
        ]
        assert np.all(error[1] < error[0])


def test_gathered_residuals_of_the_truth_are_white(gathered: ReportInputs) -> None:
    """At the truth whitened residuals have unit variance within 20 % and no correlation above 0.25."""
    (shown,) = gathered.residuals
    assert 0.8 < np.nanstd(shown.whitened) < 1.2
    for m in range(2):
        assert np.max(np.abs(autocorrelation(shown.whitened[..., m])[0])) < 0.25


def test_the_residual_is_shown_over_the_motion_of_each_joint(gathered: ReportInputs) -> None:
    """Of the truth it is about the noise at all positions, speeds, commands and loads."""
    kinds = {
        channel: [one.kind for one in gathered.spread if one.channel == channel]
        for channel in ("cart", "pole")
    }
    # The pole has no motor.
    assert kinds == {"cart": ["position", "speed", "command", "load"], "pole": ["position", "speed", "load"]}
    for one in gathered.spread:
        assert len(one.at) == len(one.size) and np.nanmax(one.size) < 2.0
    assert {s.unit for s in gathered.spread if s.channel == "cart" and s.kind == "load"} == {"N"}
    page = render(gathered)
    assert "Where on the motion they lie" in page and "pole, by speed" in page and "speed [rad/s]" in page


def test_result_folder_holds_the_report_and_the_model(gathered: ReportInputs, tmp_path: Path) -> None:
    """Everything is written and read back; without inputs there is no report."""
    robot = load_model(DESCRIPTION)
    plain = {"plain_mujoco": {"has": [], "lacks": [], "bristles": False, "difference": {"cart": 0.002}}}
    result = dataclasses.replace(gathered.result, provenance={**gathered.result.provenance, **plain})
    files = write_result(tmp_path / "a", robot, result, gathered)
    exports = {"actuators.yaml", "urdf.yaml", "values.yaml", "bam.json", "calibrated.xml", "plain_mujoco.xml"}
    assert set(files) == {"result.json", "distribution.json", "trace.npz", *exports, "report.html"}
    assert all(file.is_file() for file in files.values())
    assert f"distribution {gathered.result.distribution().digest()}" in files["calibrated.xml"].read_text()
    assert read_result(tmp_path / "a").method == "truth"
    assert "differs from that with all laws by 0.2 % of the range" in files["plain_mujoco.xml"].read_text()
    # An interrupted calibration has compared nothing.
    assert not {"report.html", "plain_mujoco.xml"} & {*write_result(tmp_path / "b", robot, gathered.result)}


def test_the_model_has_the_physics_step_of_the_fit(gathered: ReportInputs, tmp_path: Path) -> None:
    """Values that were fitted with half the step hold with that step."""
    robot = load_model(DESCRIPTION)
    half = robot.step_s / 2
    noted = {**gathered.result.provenance, "fit_step_s": half}
    finer = dataclasses.replace(gathered.result, provenance=noted)
    for result, step_s in ((gathered.result, robot.step_s), (finer, half)):
        write_result(tmp_path / "a", robot, result)
        written = mujoco.MjModel.from_xml_path(str(tmp_path / "a" / "calibrated.xml"))
        assert written.opt.timestep == pytest.approx(step_s)


def test_numbers_survive_a_model_that_cannot_be_written(gathered: ReportInputs, tmp_path: Path) -> None:
    """The model is written last: its error leaves result.json in place."""
    own = tmp_path / "calibrated.xml"
    shutil.copy(DESCRIPTION.mjcf, own)
    robot = load_model(dataclasses.replace(DESCRIPTION, mjcf=own))
    with pytest.raises(ConfigurationError, match="the model itself"):
        write_result(tmp_path, robot, gathered.result)
    assert read_result(tmp_path).estimate.tolist() == gathered.result.estimate.tolist()
