"""Advice at the end of a calibration, where it cannot be computed and where nothing is open."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.calib.design.next_recording import next_recordings
from deal_hw.calib.report.inputs import ReportInputs
from deal_hw.calib.report.page import render
from deal_hw.calibration import CalibrationResult
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.drivers.go2.descriptions.floor import parameter_space
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import Episode, align
from deal_hw.testing.simulated_episode import simulated_episode


def result(space: ParameterSpace, verdict: str, std: float = 0.3) -> CalibrationResult:
    """Return a result that is as wide as asked in each parameter."""
    K = len(space)
    return CalibrationResult(
        method="fake", space=space, estimate=space.nominal, covariance=std**2 * np.eye(K),
        interval=np.stack([space.low, space.high], axis=1), verdicts=(verdict,) * K,  # type: ignore[arg-type]
        chi2=1.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def episode() -> Episode:
    """Return two seconds of a balanced cart-pole."""
    space = k9_space()
    return align(simulated_episode(DESCRIPTION, space, space.nominal, seconds=2.0), DESCRIPTION)


def test_nothing_open_needs_nothing(episode: Episode) -> None:
    """No simulation is run where every parameter is identifiable."""
    found = result(k9_space(), "identifiable")
    assert next_recordings(load_model(DESCRIPTION), found, [episode]) == ()


def test_what_cannot_be_computed_is_said(episode: Episode) -> None:
    """A floating base gets a line a parameter that says why, and the page shows it."""
    found = result(parameter_space(), "weak")
    advice = next_recordings(load_model(GO2), found, [episode])
    assert [one.parameter for one in advice] == list(found.space.names)
    assert all("held by its trunk" in one.sentence for one in advice)
    rows = tuple(one.to_json() for one in advice)
    assert rows[0]["std"] is None
    page = render(ReportInputs(robot="go2", result=dataclasses.replace(found, advice=rows)))
    assert "What to record next" in page and "held by its trunk" in page


def test_advice_survives_the_file(episode: Episode) -> None:
    """Written and read back, the advice is the same; older files have none."""
    row = {"parameter": "p", "std": 0.5, "std_after": None, "excitation": "", "sentence": "s"}
    values = dataclasses.replace(result(k9_space(), "weak"), advice=(row,)).to_json()
    assert CalibrationResult.from_json(values).advice == (row,)
    del values["advice"]
    assert CalibrationResult.from_json(values).advice == ()
