"""result.json and distribution.json: what was written is read, and no hostile number is."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deal_hw.calibration import CalibrationResult, read_result
from deal_hw.errors import DealHwError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.workflows.train import read_distribution

REAL = Path(__file__).parent / "calibration"
"""Files that `deal-hw calibrate` has written; whatever else is refused later, these stay readable."""
SPACE = ParameterSpace(
    [
        Parameter.around("arm.mass", "body_mass", ["arm"], "kg", 1.0),
        Parameter.encoder_bias("hip", 0.1),
        Parameter.around("hand.mass", "body_mass", ["hand"], "kg", 0.3),
    ]
).with_known({"hand.mass": 0.31})
FULL = CalibrationResult(
    method="m",
    space=SPACE,
    estimate=np.array([1.2, -0.02]),
    interval=np.array([[1.1, 1.3], [-0.03, 0.01]]),
    covariance=np.array([[1e-3, 1e-5], [1e-5, 1e-4]]),
    verdicts=("identifiable", "weak"),
    latency_s=0.01,
    latency_interval_s=(0.008, 0.02),
    chi2=1.1,
    alarms=(Finding.alarm("a", "b", "c"),),
    biased={"hip.encoder_bias": "mass"},
    advice=(
        {"parameter": "hip.encoder_bias", "std": 0.3, "std_after": 0.1, "excitation": "x", "sentence": "s"},
    ),
    heldout_nrmse={"nominal": 0.2, "calibrated": 0.1, "null": 1.0},
    steps=1000,
    seconds=2.5,
    provenance={
        "seed": 1,
        "heldout_rmse": {"window_s": 0.2, "mean": {"nominal": 0.1}, "noise": {"nrmse": 0.01, "mean": 0.001}},
    },
)


@dataclass(frozen=True)
class Document:
    """A document and its reader."""

    values: Mapping[str, Any]
    name: str
    read: Callable[[Path], object]


def real(name: str) -> dict[str, Any]:
    """Return the values of a real file."""
    return dict(json.loads((REAL / name).read_text(encoding="utf-8")))


DOCUMENTS = {
    "real result": Document(real("result.json"), "result.json", read_result),
    "full result": Document(json.loads(json.dumps(FULL.to_json())), "result.json", read_result),
    "real distribution": Document(real("distribution.json"), "distribution.json", read_distribution),
    "full distribution": Document(
        json.loads(json.dumps(FULL.distribution().to_json())), "distribution.json", read_distribution
    ),
}
NO_NUMBER = (math.nan, math.inf, -math.inf, 1e308, -1e308)
"""Numbers that no field has."""
NO_KIND: tuple[object, ...] = ("0.1", True, [], {})
"""What is no number."""


def places(values: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the place of every number."""
    if isinstance(values, Mapping):
        for key, part in values.items():
            yield from places(part, (*at, key))
    elif isinstance(values, list | tuple):
        for i, part in enumerate(values):
            yield from places(part, (*at, i))
    elif isinstance(values, int | float) and not isinstance(values, bool):
        yield at


def damaged(document: Document, at: tuple[str | int, ...], value: object, folder: Path) -> Path:
    """Write a document with another value at a place; return its file."""
    values = json.loads(json.dumps(copy.deepcopy(document.values)))
    part = values
    for key in at[:-1]:
        part = part[key]
    part[at[-1]] = value
    path = folder / document.name
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


PLACES = [(name, at) for name, document in DOCUMENTS.items() for at in places(document.values)]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_what_was_written_is_read(name: str, tmp_path: Path) -> None:
    """Real files and a result that has everything."""
    document = DOCUMENTS[name]
    path = tmp_path / document.name
    path.write_text(json.dumps(document.values), encoding="utf-8")
    found = document.read(path)
    written = json.loads(json.dumps(found.to_json()))  # type: ignore[attr-defined]
    # A file from before a key existed has its default.
    known = {"unchecked": False, "prior_directions": [], **document.values}
    assert {key: known[key] for key in written} == written


@pytest.mark.parametrize(("name", "at"), PLACES, ids=[f"{n}: {'.'.join(map(str, at))}" for n, at in PLACES])
def test_no_hostile_number_is_read(name: str, at: tuple[str | int, ...], tmp_path: Path) -> None:
    """At each place: one line that names the file and the field. What nothing reads may be of any kind."""
    document = DOCUMENTS[name]
    notes = at[0] == "provenance" and at[1] != "heldout_rmse"
    for value in NO_NUMBER[::3] if notes else (*NO_NUMBER, *NO_KIND):
        path = damaged(document, at, value, tmp_path)
        with pytest.raises(DealHwError) as caught:
            document.read(path)
        text = str(caught.value)
        assert str(path) in text and "\n" not in text and len(text) < 1200
        assert named(at) in text, (value, text)


def named(at: tuple[str | int, ...]) -> str:
    """Return what a message must name of a place: the field that a person looks for."""
    # An entry of a matrix, and of a pair, goes by the name of its field.
    return str([key for key in at if isinstance(key, str)][-1])


BELOW_0 = [
    "parameters.arm.mass.estimate",
    "parameters.arm.mass.low",
    "latency_s",
    "chi2",
    "heldout_nrmse.calibrated",
    "steps",
    "seconds",
    "advice.0.std",
    "provenance.heldout_rmse.noise.nrmse",
    "provenance.heldout_rmse.window_s",
]


@pytest.mark.parametrize("place", BELOW_0)
def test_what_is_never_below_0_is_refused_there(place: str, tmp_path: Path) -> None:
    """A mass, a time, a squared or a mean error, a count."""
    parts = place.replace("arm.mass", "arm:mass").split(".")
    at = tuple(int(p) if p.isdigit() else p.replace(":", ".") for p in parts)
    assert at in set(places(FULL.to_json()))
    path = damaged(DOCUMENTS["full result"], at, -0.5, tmp_path)
    with pytest.raises(DealHwError, match=str(at[-1])):
        read_result(path)


CONTRADICTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "interval upside down": (
        {"parameters.arm.mass.low": 1.3, "parameters.arm.mass.high": 1.1},
        r"fields parameters\.arm\.mass\.low and parameters\.arm\.mass\.high are 1\.3 and 1\.1; the lower",
    ),
    "estimate outside its range": (
        {"parameters.arm.mass.estimate": 5.1},
        r"parameters\.arm\.mass\.estimate is 5\.1 kg; allowed: 0\.2 to 5, the range of 'arm\.mass'",
    ),
    "an end of an interval far outside the range": (
        {"parameters.arm.mass.high": 9.9},
        r"high is 9\.9 kg; allowed: 0 to 9\.8, the range of 'arm\.mass', and its width to",
    ),
    "latency interval upside down": ({"latency_interval_s": [0.02, 0.01]}, "the shorter one first"),
    "another nominal value": ({"parameters.arm.mass.nominal": 2.0}, "nominal is 2.0, and the field space"),
    "another unit": ({"parameters.arm.mass.unit": "g"}, "unit is g, and the field space has kg"),
    "another range": ({"parameters.arm.mass.range": [0.2, 6.0]}, "range is .0.2, 6.0., and the field space"),
    "another known value": (
        {"known": {"hand.mass": 0.3}},
        "field known.hand.mass is 0.3; allowed: 0.31, as the field space",
    ),
    "a row too many": (
        {"parameters.leg.mass": {"verdict": "weak", "estimate": 1.0, "low": 0.5, "high": 2.0}},
        "unknown parameter",
    ),
    "a cause of nothing": ({"biased": {"leg.mass": "mass"}}, "field biased.0. is 'leg.mass'"),
    "another cause": (
        {"parameters.arm.mass.biased_by": "mass"},
        "biased_by is 'mass'; allowed: as the field",
    ),
    "advice on nothing": ({"advice": [{"parameter": "leg.mass"}]}, r"advice\[0\].parameter is 'leg.mass'"),
    "a shorter covariance": ({"covariance": [[1e-3]]}, r"covariance has the shape \(1, 1\)"),
    "negative variance": (
        {"covariance": [[1e-3, 0.0], [0.0, -1e-4]]},
        "variance of 'hip.encoder_bias' is below 0",
    ),
    "not symmetric": ({"covariance": [[1e-3, 1e-4], [0.0, 1e-4]]}, "covariance is not symmetric"),
    "correlation beyond 1": (
        {"covariance": [[1e-3, 1e-2], [1e-2, 1e-4]]},
        "'arm.mass' and 'hip.encoder_bias' have 0.01, .* correlation would be outside -1 to 1",
    ),
    "an error without its alarm": (
        {"provenance.shared_error": {}, "alarms": []},
        "shared_error has no alarm beside it",
    ),
    "unchecked without a reason": ({"unchecked": True, "alarms": []}, "field unchecked has no alarm"),
    "a verdict for some": ({"parameters.arm.mass.verdict": None}, "some of the parameters have a verdict"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_a_result_that_contradicts_itself_is_refused(name: str, tmp_path: Path) -> None:
    """The message names the field."""
    changes, words = CONTRADICTIONS[name]
    values = json.loads(json.dumps(FULL.to_json()))
    for place, value in changes.items():
        part, parts = values, place.replace(".mass", ":mass").split(".")
        for key in parts[:-1]:
            part = part[key.replace(":", ".")]
        part[parts[-1].replace(":", ".")] = value
    path = tmp_path / "result.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(DealHwError, match=words):
        read_result(path)


def test_an_interval_may_leave_the_range() -> None:
    """A common factor of all forces widens those of a walk: the Go2's demo wrote 1.007 beyond an end of 1."""
    values = json.loads(json.dumps(FULL.to_json()))
    values["parameters"]["arm.mass"]["high"] = 5.035
    assert CalibrationResult.from_json(values).interval[0, 1] == 5.035


def test_what_is_not_finite_is_written_as_null() -> None:
    """JSON has no NaN; the reader gives it back."""
    found = CalibrationResult(
        method="m", space=SPACE, estimate=np.array([1.0, 0.0]), interval=np.full((2, 2), np.nan)
    )
    values = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert values["chi2"] is None and values["parameters"]["arm.mass"]["low"] is None
    again = CalibrationResult.from_json(values)
    assert math.isnan(again.chi2) and np.isnan(again.interval).all()
