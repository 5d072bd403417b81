"""Each alarm says what was seen, what it means and what to do."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import deal_hw.calib
from deal_hw.calib.hypotheses.cause_words import LOOKS
from deal_hw.calibration import CalibrationResult, listed
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace

ROOT = Path(deal_hw.calib.__file__).resolve().parents[1]


def raised() -> Iterator[tuple[str, ast.Call]]:
    """Yield where each alarm of the calibrators and of the command is made."""
    for folder in ("calib", "deal_hw/cli"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == "Finding.alarm":
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def test_no_alarm_lacks_a_part() -> None:
    """Three parts each; what was seen has a number or names, and what is written out ends a sentence."""
    found = list(raised())
    assert len(found) >= 10
    for where, call in found:
        if all(isinstance(part, ast.Attribute | ast.Subscript) for part in call.args):
            continue  # Read from a file.
        assert len(call.args) == 3 and not call.keywords, where
        seen, *rest = call.args
        assert isinstance(seen, ast.Name) or any(isinstance(n, ast.FormattedValue) for n in ast.walk(seen)), (
            f"{where} says what was seen without a number"
        )
        for part in (seen, *rest):
            if isinstance(part, ast.JoinedStr | ast.Constant):
                assert ast.unparse(part).rstrip("'\"").endswith("."), f"{where} does not end a sentence"


@pytest.mark.parametrize("parts", [("", "b", "c"), ("a", " ", "c"), ("a", "b", "")])
def test_an_empty_part_is_refused(parts: tuple[str, str, str]) -> None:
    """So what comes from elsewhere cannot lack one either."""
    with pytest.raises(ValueError, match="three parts"):
        Finding.alarm(*parts)


@pytest.mark.parametrize(
    ("alarms", "message"),
    [
        ("x", "alarms is 'x'"),
        (["x"], r"alarms\[0\] is 'x'"),
        ([{"seen": "a", "do": "c"}], r"alarms\[0\]\.means"),
    ],
)
def test_a_damaged_result_names_the_alarm(alarms: object, message: str) -> None:
    """Of a file that somebody edited the field is named."""
    space = ParameterSpace([Parameter.around("a", "mass", ["x"], "kg", 1.0)])
    values = CalibrationResult(
        method="m", space=space, estimate=space.nominal, interval=np.array([[0.5, 2.0]]), chi2=1.0
    ).to_json()
    with pytest.raises(ConfigurationError, match=message):
        CalibrationResult.from_json({**values, "alarms": alarms})


def test_causes_of_a_residual_have_all_parts() -> None:
    """Every cause that can be diagnosed says what it looks like, what it means and what to do."""
    for cause, (looks, means, do) in LOOKS.items():
        assert looks and means.endswith(".") and do.endswith(".") and "{}" in do, cause


def test_an_alarm_is_one_line_where_one_line_is_wanted() -> None:
    """And long lists of names are cut."""
    assert (
        str(Finding.alarm("3 mm of play.", "The gear is worn.", "Mend it."))
        == "3 mm of play. The gear is worn. Mend it."
    )
    assert listed(["a", "b"]) == "a, b"
    assert listed([str(k) for k in range(9)]) == "0, 1, 2, 3, 4, 5 and 3 more"
