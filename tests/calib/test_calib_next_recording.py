"""Advice at the end of a calibration, where it cannot be computed and where nothing is open."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from fakes.simulated_episode import simulated_episode

from deal_hw.calib.design.advice import menu_designs, next_recordings, next_step, options
from deal_hw.calib.report.gather import ReportInputs
from deal_hw.calib.report.page import render
from deal_hw.calibration import CalibrationResult
from deal_hw.cli.calibrate_output import print_result
from deal_hw.cli.main import main
from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.drivers.go2.descriptions.floor import parameter_space
from deal_hw.install import install_line
from deal_hw.motions.excitation.plan import read_plan
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align
from deal_hw.workflows.shipped import shipped_balancer


def result(space: ParameterSpace, verdict: str, std: float = 0.3) -> CalibrationResult:
    """Return a result that is as wide as asked in each parameter."""
    K = len(space)
    return CalibrationResult(
        method="fake",
        space=space,
        estimate=space.nominal,
        covariance=std**2 * np.eye(K),
        interval=np.stack([space.low, space.high], axis=1),
        verdicts=(verdict,) * K,  # type: ignore[arg-type]
        chi2=1.0,
    )


@pytest.fixture(scope="module")
def episode() -> SampledEpisode:
    """Return two seconds of a balanced cart-pole."""
    space = k9_space()
    return align(simulated_episode(DESCRIPTION, space, space.nominal, seconds=2.0), DESCRIPTION)


def test_nothing_open_needs_nothing(episode: SampledEpisode) -> None:
    """No simulation is run where every parameter is identifiable."""
    found = result(k9_space(), "identifiable")
    assert next_recordings(load_model(DESCRIPTION), found, [episode]) == ()


def test_what_cannot_be_computed_is_said(episode: SampledEpisode) -> None:
    """A floating base gets a line a parameter that says why, and the page shows it."""
    found = result(parameter_space(), "weak")
    advice = next_recordings(load_model(GO2), found, [episode])
    assert [one.parameter for one in advice] == list(found.space.names)
    assert all("held by its trunk" in one.sentence for one in advice)
    rows = tuple(one.to_json() for one in advice)
    assert rows[0]["std"] is None
    page = render(ReportInputs(robot="go2", result=dataclasses.replace(found, advice=rows)))
    assert "What to record next" in page and "held by its trunk" in page


def test_advice_without_onnxruntime_names_the_extra(
    episode: SampledEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motions of the menu begin with a policy that balances; the calibration itself needs none."""
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    found = result(k9_space(), "weak")
    advice = next_recordings(
        load_model(DESCRIPTION), found, [episode], balance=shipped_balancer(DESCRIPTION), threads=1
    )
    assert [one.parameter for one in advice] == list(found.space.names)
    assert all(install_line("deploy") in one.sentence for one in advice)


def test_advice_survives_the_file(episode: SampledEpisode) -> None:
    """Written and read back, the advice is the same; older files have none."""
    row = {"parameter": "cart.mass", "std": 0.5, "std_after": None, "excitation": "", "sentence": "s"}
    values = dataclasses.replace(result(k9_space(), "weak"), advice=(row,)).to_json()
    assert CalibrationResult.from_json(values).advice == (row,)
    del values["advice"]
    assert CalibrationResult.from_json(values).advice == ()


def row(name: str, after: float, excitation: str, command: str = "--family steps") -> dict[str, object]:
    """Return one row of advice: 60 % now, ``after`` with a recording."""
    sentence = f"record {excitation}: {name} goes from 60 % to {100 * after:.2g} %, which is still weak"
    if not excitation:
        sentence = f"{name} is open at 60 %"
    return {
        "parameter": name,
        "std": 0.6,
        "std_after": after,
        "excitation": excitation,
        "sentence": sentence,
        "command": command,
    }


def test_one_step_is_next_with_its_commands() -> None:
    """The recording that helps most is named once with all it helps; what none helps is to be measured."""
    rows = [row("a", 0.3, "steps"), row("b", 0.2, "a chirp"), row("c", 0.5, "steps"), row("m", 0.6, "")]
    assert next_step(rows, "cartpole") == [
        "record a chirp: b goes from 60 % to 20 %",
        "    deal-hw design-excitation cartpole --family steps --out next.json",
        "    deal-hw collect cartpole --excite next.json --port PORT --dataset runs/first/dataset",
        "    deal-hw calibrate runs/first/dataset",
        "no recording helps with m: measure it by other means, then --known NAME VALUE",
    ]
    assert next_step([*rows, row("d", 0.3, "steps")])[0] == (
        "record steps: a goes from 60 % to 30 %, c goes from 60 % to 50 %, d goes from 60 % to 30 %"
    )
    # Punctuation of an excitation's description does not end what it helps.
    assert next_step([row("a", 0.3, "steps: small, slow")])[0] == (
        "record steps: small, slow: a goes from 60 % to 30 %"
    )
    assert next_step(rows[3:]) == ["m is open at 60 %"]
    assert next_step([]) == []


@pytest.mark.slow
def test_the_command_makes_the_recording_that_was_reckoned_with(tmp_path: Path) -> None:
    """`deal-hw design-excitation` with the options of each of the menu's designs writes that very plan."""
    for name, design in menu_designs(DESCRIPTION, balances=True).items():
        out = tmp_path / "next.json"
        assert (
            main(["design-excitation", "cartpole", *options(design).split(), "--out", str(out), "--quiet"])
            == 0
        )
        assert read_plan(out).words == name


def test_what_is_printed_names_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    """The command that follows a calibration is to be copied; it named the table's last column once."""
    found = dataclasses.replace(
        result(k9_space(), "weak"),
        advice=(row("a", 0.3, "steps"),),
        provenance={"dataset": "runs/mine/dataset"},
    )
    print_result(found, "record another motion", "cartpole")
    printed = capsys.readouterr().out
    assert "deal-hw collect cartpole --excite next.json --port PORT --dataset runs/mine/dataset" in printed
    assert "    deal-hw calibrate runs/mine/dataset" in printed
    assert "collect verdict" not in printed
    assert "next: record steps" in printed
    print_result(dataclasses.replace(found, chi2=9.0), "record another motion", "cartpole")
    assert "next, after the causes that alarms name: record steps" in capsys.readouterr().out
