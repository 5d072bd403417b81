"""Servo gains from gravity: the truth lies within the stated error, also in a few seconds of motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.sim.recordings.gravity_gain import GravityGain, gravity_gain
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration import checks
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_truth_lies_within_four_standard_errors(seed: int, tmp_path: Path) -> None:
    """An arm of three joints, 6 s of motion: both loaded joints, and the vertical one says nothing."""
    robot = make_robot("arm", seed)
    model, paths, _ = write(robot, tmp_path, seconds=6.0)
    work = calibration_input(FilesSettings(model=model, data=paths))
    found = gravity_gain(work.robot, list(work.episodes))
    assert found is not None
    truth = np.array([robot.truth[f"{joint}.servo_stiffness"] for joint in ("shoulder", "elbow")])
    assert np.all(np.abs(1 / found.gain[1:] - 1 / truth) < 4 * found.error[1:])
    assert np.all(found.error[1:] < 0.5 / truth)
    assert np.isinf(found.gain[0])


def test_a_gain_that_chance_explains_is_no_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same gain, far outside the search range: with a small error a warning, with a large one none."""
    model, paths, _ = write(make_robot("pendulum", 0), tmp_path, seconds=3.0)
    work = calibration_input(FilesSettings(model=model, data=paths))
    for error, warned in ((0.1, True), (0.6, False)):
        found = GravityGain(*(np.array([v]) for v in (0.5, error, 0.6, 0.1, 0.03)))
        monkeypatch.setattr("deal_hw.sim.recordings.gravity_gain.gravity_gain", lambda *_, f=found: f)
        printed: list[str] = []
        checks.warn_of_gravity(work.robot, work.space, list(work.episodes), printed.append)
        assert bool(printed) is warned
    found = GravityGain(*(np.array([v]) for v in (0.5, 0.1, 0.6, 0.1, 0.03)))
    monkeypatch.setattr("deal_hw.sim.recordings.gravity_gain.gravity_gain", lambda *_: found)
    work.robot.model.dof_frictionloss[:] = 0.2
    printed = []
    checks.warn_of_gravity(work.robot, work.space, list(work.episodes), printed.append)
    assert not printed, "dry friction of 0.2 N·m holds 0.1 N·m"
