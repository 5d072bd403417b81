"""Friction, damping and armature that are 0 in the model: tried as laws are, and taken with their values."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.hypotheses.laws import ZEROS
from deal_hw.testing.plain_faults import WITHOUT, Fault
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration.intake import calibration_input, usual_method
from deal_hw.workflows.calibration.run import calibrate_input
from deal_hw.workflows.calibration.settings import FilesSettings


def test_one_is_a_candidate_for_each_kind_and_several_are_one_more(tmp_path: Path) -> None:
    """A model with all of them has none of these candidates."""
    joints = ("shoulder", "elbow")
    friction, damping, rotor = (
        [f"{joint}.{name}" for joint in joints] for name in ("frictionloss", "damping", "armature")
    )
    expected: dict[Fault | None, list[list[str]]] = {
        None: [[], [], [], []],
        "no-friction": [friction, [], [], []],
        "no-rotor": [[], [], rotor, []],
        "bare": [friction, damping, rotor, [*friction, *damping, *rotor]],
    }
    for fault, names in expected.items():
        folder = tmp_path / str(fault)
        folder.mkdir()
        model, data, _ = write(make_robot("double-pendulum", 3, fault), folder, seconds=3.0)
        work = calibration_input(FilesSettings(model=model, data=data, threads=1))
        problem = Problem(work.robot, work.space, work.episodes, threads=1)
        assert [[p.name for p in each.parameters(problem)] for each in ZEROS] == names


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "fault", "within"),
    [("double-pendulum", "no-friction", 0.1), ("pendulum", "bare", 0.1), ("cart-pole", "no-rotor", 0.1)],
)
def test_what_is_0_in_the_model_is_found(tmp_path: Path, kind: str, fault: Fault, within: float) -> None:
    """With the values of the robot; the others then are the robot's, too, and only noise is left."""
    robot, said = make_robot(kind, 3, fault), list[str]()
    model, data, held_out = write(robot, tmp_path)
    # What an MJCF can say is no law.
    settings = FilesSettings(model=model, data=data, holdout=held_out, threads=1, laws=kind != "cart-pole")
    space = calibration_input(settings).space
    # A mass would take the place of a rotor: these are weighed.
    weighed = {p.name: p.nominal for p in space if p.kind in ("body_mass", "encoder_bias")}
    settings = dataclasses.replace(settings, known=weighed)
    work = calibration_input(settings, say=said.append)
    result = calibrate_input(settings, work, usual_method(settings, work))
    assert any(text.startswith("0 in the model: ") for text in said)
    found = dict(zip(result.space.names, map(float, result.estimate), strict=True))
    lacked = {n: value for n, value in robot.truth.items() if n.split(".")[1] in WITHOUT[fault]}
    assert {name: found.get(name) for name in lacked} == pytest.approx(lacked, rel=within)
    assert result.chi2 < 1.2
    assert "0 in the model" in str(result.alarms[0]) and result.alarms[0].do.startswith("Use this result")
    assert result.heldout_nrmse["calibrated"] < 0.2 * result.heldout_nrmse["nominal"]
