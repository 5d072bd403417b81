"""What `deal-hw calibrate` prints last: alarms in few lines, and the one that matters above the prompt."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.calib.validation.time_steps import StepCheck
from deal_hw.calibration import CalibrationResult
from deal_hw.cli.calibrate_output import ALARM_LINES, other_alarms, print_result, print_verdict
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace

CAUSE = Finding.alarm(
    "With hand 57 % heavier the model predicts left-out motion with 83 % less residual: another mass.",
    "The ratio of the bodies' masses is not the model's.",
    "Weigh hand, correct the model, or free body_mass there (--parameters).",
)
LONG = "Residuals of the elbow are larger than the sensor's noise by a factor of 3.1 in each recording. "


def doubtful(*alarms: Finding) -> CalibrationResult:
    """Return a result with alarms, better than nominal on held-out motion."""
    space = ParameterSpace(
        [Parameter.around("elbow.stiffness", "servo_stiffness", ["elbow"], "N·m/rad", 30.0)]
    )
    return CalibrationResult(
        method="output-error",
        space=space,
        estimate=np.array([19.9]),
        interval=np.array([[12.0, 33.0]]),
        verdicts=("weak",),
        chi2=9.0,
        alarms=alarms,
        heldout_nrmse={"nominal": 0.02, "calibrated": 0.005, "null": 1.0},
        provenance={"diagnosis": [{}]},
        biased={"elbow.stiffness": "mass", "latency": "mass"},
    )


def test_the_first_alarm_is_the_last_thing_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Six alarms of three lines each: at most 20 lines, and what to do about the first is the last line."""
    others = [Finding.alarm(f"{k}: {2 * LONG}", "It is wrong.", f"Repair it, way {k}.") for k in range(5)]
    print_verdict(doubtful(CAUSE, *others))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= ALARM_LINES
    printed = " ".join(" ".join(lines).split())
    assert printed.endswith(CAUSE.do)
    assert (
        printed.index("more alarm")
        < printed.index("0: Residuals")
        < printed.index("amber:")
        < printed.index("first alarm")
    )
    assert f"first alarm: {CAUSE.seen} {CAUSE.means}" in printed


def test_a_physics_step_that_was_not_compared_has_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    """The reason of the check's note, with the step that it is about."""
    check = StepCheck(0.002, note="not compared: it would take 4e+08 physics steps")
    step = {"physics_step": check.to_json()}
    print_result(dataclasses.replace(doubtful(), provenance=step), "record one")
    printed = " ".join(capsys.readouterr().out.split())
    assert "check of the physics step, 2 ms: not compared: it would take 4e+08 physics steps" in printed


def test_alarms_with_one_remedy_are_one_entry() -> None:
    """Two values at bounds ask for one thing; nothing is hidden where there is room."""
    widen = "Widen the range."
    words = [("a ended there.", widen), ("b jitters.", "y"), ("c did.", widen)]
    alarms = [Finding.alarm(seen, "x", do) for seen, do in words]
    assert other_alarms(alarms, 80, 20) == ["alarm: b jitters.", "alarm: a ended there. c did."]
    assert other_alarms(alarms, 80, 2) == [
        "1 more alarm: see result.json or the report",
        "alarm: a ended there. c did.",
    ]
    assert other_alarms(alarms, 80, 1) == ["3 more alarms: see result.json or the report"]


def test_a_biased_value_is_marked_in_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    """The cause stands beside the verdict of each value that it moved, the latency's too."""
    print_result(doubtful(CAUSE), "record another motion")
    printed = capsys.readouterr().out
    assert "weak, biased by mass" in printed and printed.count("biased by mass") == 2


def test_a_check_that_was_not_run_is_named_with_its_option(capsys: pytest.CaptureFixture[str]) -> None:
    """Parts of recordings that the user left out are something else."""
    notes = {"left_out": [["a.csv", 1.0, 2.0]], "checks_left_out": {"shared errors": "3 of 5 were not tried"}}
    print_result(dataclasses.replace(doubtful(CAUSE), provenance=notes), "record another motion")
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "check of shared errors: 3 of 5 were not tried (--checks all)" in printed and "a.csv" not in printed
    )
