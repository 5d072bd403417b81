"""JSON of our own documents: each comes back as it was, and a damaged one raises our error or is read."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deal_hw.calibration import CalibrationResult
from deal_hw.control.loop.timing import LoopTimingReport, Spread
from deal_hw.drivers.b2.emulator import B2Truth
from deal_hw.drivers.cartpole.plant.truth import CartpoleTruth
from deal_hw.drivers.cartpole.plant.truth import nominal_truth as nominal_cartpole
from deal_hw.drivers.g1.emulator.truth import G1Truth
from deal_hw.drivers.g1.emulator.truth import draw_truth as draw_g1
from deal_hw.drivers.go2.emulator.truth import Go2Truth
from deal_hw.drivers.go2.emulator.truth import draw_truth as draw_go2
from deal_hw.drivers.h1.emulator import H1Truth
from deal_hw.errors import ConfigurationError
from deal_hw.findings import Finding
from deal_hw.parameters import Parameter, ParameterDistribution, ParameterSpace
from deal_hw.schema import plain
from deal_hw.transport import WireOptions
from deal_hw.workflows.running.plan import RunPlan

SPACE = ParameterSpace(
    [
        Parameter.around("a", "mass", ["x"], "kg", 1.0),
        Parameter.encoder_bias("hip", 0.1),
    ]
)
SPREAD = Spread(1e-3, 2e-3, math.nan)
DOCUMENTS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "result": (
        CalibrationResult(
            method="m",
            space=SPACE,
            estimate=SPACE.nominal,
            interval=np.stack([SPACE.low, SPACE.high], axis=1),
            covariance=np.eye(2),
            verdicts=("identifiable", "weak"),
            null_directions=("a + b",),
            latency_s=0.01,
            latency_interval_s=(0.0, 0.02),
            chi2=1.1,
            alarms=(Finding.alarm("a", "b", "c"),),
            biased={"a": "mass"},
            advice=({"parameter": "a"},),
            heldout_nrmse={"null": 1.0},
            provenance={"seed": 1},
        ).to_json(),
        lambda values: json.loads(json.dumps(CalibrationResult.from_json(values).to_json())),
    ),
    "distribution": (
        ParameterDistribution(
            space=SPACE, mean=SPACE.nominal, covariance=np.eye(2), latency_s=(0.0, 0.01)
        ).to_json(),
        lambda values: json.loads(json.dumps(ParameterDistribution.from_json(values).to_json())),
    ),
    "loop timing": (
        LoopTimingReport(
            rate_hz=50.0,
            cycles=3,
            period=SPREAD,
            lateness=SPREAD,
            overruns=0,
            overruns_beyond_period=0,
            skipped_periods=0,
            state_age=SPREAD,
            sections={"send": SPREAD},
        ).to_json(),
        lambda values: LoopTimingReport.from_json(values).to_json(),
    ),
    "truth of a cart-pole": (
        nominal_cartpole("realistic", 3, sensing_ticks=2).to_json(),
        lambda values: CartpoleTruth.from_json(values).to_json(),
    ),
    "truth of a B2": (
        B2Truth.draw("realistic", 5).to_json(),
        lambda values: B2Truth.from_json(values).to_json(),
    ),
    "truth of an H1": (
        H1Truth.draw("realistic", 5).to_json(),
        lambda values: H1Truth.from_json(values).to_json(),
    ),
    "truth of a G1": (
        draw_g1("realistic", 5).to_json(),
        lambda values: G1Truth.from_json(values).to_json(),
    ),
    "truth of a Go2": (
        draw_go2("realistic", 5).to_json(),
        lambda values: Go2Truth.from_json(values).to_json(),
    ),
    "options of a wire": (
        WireOptions(listen=True, certificate=Path("a.pem"), key=Path("b.pem")).to_json(),
        lambda values: WireOptions.from_json(values).to_json(),
    ),
    "plan of a run": (
        RunPlan(robot="cartpole", robot_settings={"a": 1}).to_json(),
        lambda values: RunPlan.from_json(values).to_json(),
    ),
}
JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(max_size=4),
    st.lists(st.integers(), max_size=3),
    st.dictionaries(st.text(max_size=2), st.integers(), max_size=2),
)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_comes_back_as_it_was(name: str) -> None:
    """Through JSON text, keys and values are the same."""
    values, again = DOCUMENTS[name]
    assert again(json.loads(json.dumps(values))) == json.loads(json.dumps(values))


@pytest.mark.parametrize("name", DOCUMENTS)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_document_raises_our_error_or_none(name: str, data: st.DataObject) -> None:
    """One value, anywhere, is another, or is left out: the message is one line."""
    values, again = DOCUMENTS[name]
    damaged = copy.deepcopy(values)
    part: Any = damaged
    while True:
        keys = list(part) if isinstance(part, dict) else list(range(len(part)))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(part[key], dict | list) or not part[key] or data.draw(st.booleans()):
            break
        part = part[key]
    if data.draw(st.booleans()):
        del part[key]
    else:
        part[key] = data.draw(JUNK)
    try:
        again(damaged)
    except ConfigurationError as error:
        assert "\n" not in str(error)


def test_what_is_wrong_is_named_with_its_place_and_value() -> None:
    """The field, what it is, and what is allowed."""
    values, again = DOCUMENTS["result"]
    damaged = copy.deepcopy(values)
    damaged["parameters"]["a"]["verdict"] = "sure"
    damaged["heldout_nrmse"]["null"] = "good"
    with pytest.raises(
        ConfigurationError,
        match=r"field parameters\.a\.verdict is 'sure'; .*'weak'.*; field heldout_nrmse\.null is 'good'; .*",
    ):
        again(damaged)


def test_a_result_of_an_older_version_is_read() -> None:
    """It had no causes, no advice, and null for what was not finite."""
    values, _ = DOCUMENTS["result"]
    old = {key: value for key, value in values.items() if key not in ("biased", "advice", "known")}
    old |= {"chi2": None, "covariance": None}
    for row in old["parameters"].values():
        row["verdict"], row["low"] = None, None
        del row["biased_by"]
    found = CalibrationResult.from_json(old)
    assert math.isnan(found.chi2) and found.verdicts == () and np.isnan(found.interval[:, 0]).all()


def test_plain_values_of_any_type() -> None:
    """Arrays and tuples become lists, paths and enumerations text, and what is not finite null."""
    assert plain({"a": np.arange(2), "b": (Path("x"), math.nan), "c": np.float64(np.inf)}) == {
        "a": [0, 1],
        "b": ["x", None],
        "c": None,
    }
    assert plain((math.inf,), finite=False) == [math.inf]
