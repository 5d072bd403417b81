"""The report's first sentence, against numbers worked out by hand."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from deal_hw.calib.report.gather import ReportInputs
from deal_hw.calib.report.page import compared_fits, render
from deal_hw.calib.report.verdict import compared, make_story, percent
from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import Parameter, ParameterSpace

NAN, INF = float("nan"), float("inf")


def result(heldout: dict[str, float], **changes: Any) -> CalibrationResult:
    """Return a result of one parameter with these held-out errors."""
    space = ParameterSpace([Parameter.around("mass", "body_mass", ("arm",), "kg", 1.0)])
    return CalibrationResult(
        method="eki",
        space=space,
        estimate=np.ones(1),
        interval=np.array([[0.9, 1.1]]),
        heldout_nrmse=heldout,
        **changes,
    )


@pytest.mark.parametrize(
    ("nominal", "calibrated", "words"),
    [
        (0.264, 0.011, "24 times better than the nominal model"),
        (0.05, 0.02, "2.5 times better than the nominal model"),
        # 1 - 0.05 / 0.06 = 1/6.
        (0.06, 0.05, "17 % better than the nominal model"),
        (0.05, 0.0505, "no better than the nominal model"),
        (0.05, 0.0495, "no better than the nominal model"),
        (0.05, 0.06, "worse than the nominal model, with 1.2 times its error"),
        (0.01, 0.24, "worse than the nominal model, with 24 times its error"),
        (0.05, NAN, "worse than the nominal model: it diverges"),
        (INF, 0.05, "better than the nominal model, which diverges"),
        (0.5, 0.0, "more than 1000 times better than the nominal model"),
    ],
)
def test_errors_are_compared_in_plain_words(nominal: float, calibrated: float, words: str) -> None:
    """Better, no better and worse, by how many times or by how many percent."""
    assert compared(nominal, calibrated) == words


def test_the_sentence_tells_the_held_out_gain() -> None:
    """26.4 % against 1.1 % is 24 times; the bars are 100 % and 1.1 / 26.4 = 4.17 % long."""
    story = make_story(result({"nominal": 0.264, "calibrated": 0.011, "null": 0.5}))
    assert story.sentence.replace("\u00a0", " ") == (
        "The calibrated simulator predicts motion that it was not given 24 times better than the nominal "
        "model: its error is 1.1 % of the motion's range against 26 %."
    )
    assert [(bar.name, bar.words) for bar in story.bars] == [
        ("nominal", percent(0.264)),
        ("calibrated", "1.1\u00a0%"),
    ]
    assert [bar.share for bar in story.bars] == pytest.approx([100, 4.167], abs=1e-3)
    assert story.floor is None and story.in_units == ""


def test_a_model_that_got_worse_is_said_to_be_worse() -> None:
    """The longest bar is then the calibrated one."""
    story = make_story(result({"nominal": 0.05, "calibrated": 0.06, "null": 0.5}))
    assert "worse than the nominal model, with 1.2 times its error" in story.sentence
    assert [bar.share for bar in story.bars] == pytest.approx([83.33, 100], abs=0.01)


def test_a_model_that_diverges_has_no_number() -> None:
    """Its bar is full and says so."""
    story = make_story(result({"nominal": 0.05, "calibrated": NAN}))
    assert story.sentence.endswith("worse than the nominal model: it diverges.")
    assert (story.bars[1].words, story.bars[1].share) == ("diverged", 100.0)


def test_without_held_out_recordings_nothing_is_claimed() -> None:
    """No gain and no bars; what is known of the fit is reported. chi2 of 4 is twice the noise."""
    story = make_story(result({}, chi2=4.0))
    assert (
        story.sentence.startswith("It is not known how well")
        and "2.0 times the sensor's noise" in story.sentence
    )
    assert story.bars == () and "noise" not in make_story(result({})).sentence


def test_units_and_noise_stand_beside_the_gain() -> None:
    """Noise of 0.5 % on a bar of 26.4 % is at 1.89 %; the unit is rad where all joints have it, else none."""
    rmse: dict[str, Any] = {
        "mean": {"nominal": 0.0266, "calibrated": 0.0011},
        "unit": {"hip": "rad", "knee": "rad"},
        "noise": {"nrmse": 0.005, "mean": 0.0004, "by_coordinate": {"hip": 0.0004, "knee": 0.0004}},
    }
    heldout = {"nominal": 0.264, "calibrated": 0.011}
    story = make_story(result(heldout, provenance={"heldout_rmse": rmse}))
    assert story.in_units == "In rad, mean over the joints: nominal 0.027, calibrated 0.0011."
    assert story.floor == pytest.approx(1.894, abs=1e-3) and story.floor_words == "0.5\u00a0%"
    rmse["unit"]["hip"], rmse["noise"]["nrmse"] = "m", None
    story = make_story(result(heldout, provenance={"heldout_rmse": rmse}))
    assert story.in_units == "" and story.floor is None
    rmse["unit"]["hip"], rmse["mean"]["nominal"] = "rad", None
    assert make_story(result(heldout, provenance={"heldout_rmse": rmse})).in_units == ""


def test_percent_has_two_digits() -> None:
    """Also above 100 %, and few where a prediction diverged."""
    assert percent(2e300) == "2e+302\u00a0%"
    assert [percent(v) for v in (0.0012345, 0.5, 2.34)] == ["0.12\u00a0%", "50\u00a0%", "234\u00a0%"]


def test_candidate_explanations_stand_with_what_they_gain_and_what_became_of_them() -> None:
    """A law in the result, a named mass, and one that gains nothing to speak of, which is no figure."""
    rows = [
        {
            "explanation": "friction that grows <with> load",
            "judged": "folds",
            "outcome": "taken",
            "deviance": 48.07,
            "share": 0.551,
            "values": {},
        },
        {
            "explanation": "another mass of arm",
            "judged": "effect",
            "outcome": "named",
            "deviance": 31.0,
            "share": None,
            "values": {},
        },
        {
            "explanation": "play in the gears",
            "judged": "fit",
            "outcome": "chance",
            "deviance": 0.03,
            "share": 0.0004,
            "values": {},
        },
    ]
    heldout = {"nominal": 0.1, "calibrated": 0.02}
    page = render(ReportInputs(robot="arm", result=result(heldout, provenance={"candidates": rows})))
    table = page.split("What could explain the rest")[1].split("</table>")[0]
    cells = [re.findall(r"<td[^>]*>(?:<span[^>]*>)?([^<]*)<", row) for row in table.split("<tr>")[2:]]
    assert cells == [
        [
            "friction that grows &lt;with&gt; load",
            "a fit in every fold",
            "55 %",
            "48.1",
            "in this result",
        ],
        ["another mass of arm", "its effect around the fit", "–", "31", "named"],
        ["play in the gears", "a fit to a part of the recordings", "–", "–", "no better than without it"],
    ]
    assert "What could explain" not in render(ReportInputs(robot="arm", result=result(heldout)))


def test_the_compared_fits_stand_best_first_with_their_errors() -> None:
    """By hand: 3 and 12 have the geometric mean 6, twice that of 3 and 3; without folds there is no table."""
    choice = {
        "chosen": "long",
        "errors": {"short": [3.0, 12.0], "long": [3.0, 3.0], "long, <play>": [2.0, 4.0]},
        "window_s": 2.0,
    }
    fits = compared_fits(choice)
    assert [(fit.name, fit.chosen) for fit in fits] == [
        ("long, <play>", False),
        ("long", True),
        ("short", False),
    ]
    assert [fit.ratio for fit in fits] == pytest.approx([8**0.5 / 3, 1.0, 2.0])
    heldout = {"nominal": 0.1, "calibrated": 0.02}
    found = result(heldout, provenance={"cross_validation": choice})
    page = render(ReportInputs(robot="arm", result=found))
    row = page.split("long, &lt;play&gt;</td>")[1].split("</tr>")[0]
    assert re.findall(r">([\d.]+)<", row) == ["2", "4", "0.94"]
    assert page.count("<b>(chosen)</b>") == 1 and '<th class="n">fold 2</th>' in page
    assert compared_fits({"chosen": "nominal", "note": "too few"}) == []
    assert "Fits that were compared" not in render(ReportInputs(robot="arm", result=result(heldout)))
