"""A policy of unitree_rl_gym for an H1: from its TorchScript and yaml to runs on an emulated robot."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
from fakes import foreign_policy

import deal_hw
from deal_hw.control.process.channel import Outcome
from deal_hw.data.recording.reader import read_episode
from deal_hw.drivers.h1.description import DESCRIPTION
from deal_hw.drivers.h1.joints import MOTORS
from deal_hw.errors import PolicyError, SafetyError
from deal_hw.policies import walking_trial
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.workflows.running.settings import CraneOptions, H1LinkOptions

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

HUNG, ZENOH = CraneOptions(hung_on_crane=True), H1LinkOptions(transport="zenoh")
YAML = foreign_policy.h1_gym_yaml()
LEGS = [DESCRIPTION.actuated.index(MOTORS[motor]) for motor in YAML["leg_joint2motor_idx"]]
HELD = [k for k in range(len(DESCRIPTION.actuated)) if k not in LEGS]
KICK = 12.0
"""Action of a knee, about 3 rad."""


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """One robot for each command shows that a policy does not walk."""
    trial = walking_trial.WalkingTrial(seconds=2.0, robots=1)
    monkeypatch.setattr(
        walking_trial, "try_walking", functools.partial(walking_trial.try_walking, trial=trial)
    )


def script(folder: Path, *, kicks: bool = False) -> Path:
    """Write a small LSTM for an H1; one that kicks throws both knees from one end to the other."""
    # Not while the tests are collected: torch takes seconds.
    import torch
    from fakes.recurrent_modules import Recurrent

    torch.manual_seed(1)
    module = Recurrent(1, 41, 10).eval()
    if kicks:
        # The clock's sine, entry 39, is the cell's input; open gates let it through to the knees' targets.
        weights = {name: torch.zeros_like(value) for name, value in module.state_dict().items()}
        weights["memory.weight_ih_l0"][32, 39] = 3.0
        weights["memory.bias_ih_l0"][16:32] = -5.0
        weights["memory.bias_ih_l0"][[0, 48]] = 5.0
        weights["actor.0.weight"][0, 0] = 1.0
        knees = [row for row, k in enumerate(LEGS) if "knee" in DESCRIPTION.actuated[k]]
        weights["actor.2.weight"][knees, 0] = KICK
        module.load_state_dict(weights)
    return foreign_policy.save_script(module, folder / "motion.pt")


def imported(folder: Path, *, kicks: bool = False) -> tuple[Path, list[str]]:
    """Import the network although it does not walk; return the file and what was said."""
    said: list[str] = []
    report = deal_hw.import_policy(
        script(folder, kicks=kicks),
        config=foreign_policy.write_yaml(folder / "h1.yaml", YAML),
        robot="h1",
        out=folder / "walk.onnx",
        force=True,
        say=said.append,
    )
    assert report.path is not None and report.walk is not None
    return report.path, said


def test_a_policy_that_does_not_walk_is_found_on_a_floor(tmp_path: Path) -> None:
    """The import tries it there, though the robot hangs: nothing is written, or only by force."""
    report = deal_hw.import_policy(
        script(tmp_path),
        config=foreign_policy.write_yaml(tmp_path / "h1.yaml", YAML),
        robot="h1",
        out=tmp_path / "walk.onnx",
    )
    assert report.path is None and report.untried == "" and len(report.faults) >= 6
    path, said = imported(tmp_path)
    assert any("h1 on a floor, though it is driven on a crane only" in line for line in said)
    assert OnnxPolicy(path).spec.training["calibration_verdict"] == "red"


def test_an_imported_policy_moves_an_emulated_h1(tmp_path: Path) -> None:
    """Deploy asks twice, then the legs follow the network with its gains, and the other joints keep still."""
    path, _ = imported(tmp_path)
    with deal_hw.emulate("h1", transport="zenoh", port="tcp/127.0.0.1:0", profile="sensor", seed=1) as robot:
        run = functools.partial(
            deal_hw.deploy, "h1", port=robot.port, link=ZENOH, policy=path, out=tmp_path, seconds=1.0
        )
        with pytest.raises(PolicyError, match="failed in the simulator"):
            run(crane=HUNG)
        with pytest.raises(SafetyError, match="--hung-on-crane"):
            run(trust_calibration=True)
        done = run(crane=HUNG, trust_calibration=True)
    assert done.outcome is Outcome.FINISHED
    found = read_episode(done.paths[0])
    answers, asked = found.cycles.action, found.cycles.requested_position
    acted = np.isfinite(answers).all(axis=1) & np.isfinite(asked).all(axis=1)
    assert acted.sum() > 30 and np.ptp(answers[acted][:, LEGS], axis=0).min() > 1e-3
    centre = np.zeros(len(DESCRIPTION.actuated))
    centre[LEGS] = YAML["default_angles"]
    scale = np.zeros(len(DESCRIPTION.actuated))
    scale[LEGS] = YAML["action_scale"]
    np.testing.assert_allclose(asked[acted], centre + scale * answers[acted], atol=1e-5)
    np.testing.assert_array_equal(asked[acted][:, HELD], 0.0)
    np.testing.assert_array_equal(found.trajectory.stiffness[-1][LEGS], YAML["kps"])
    assert robot.truth["commands"]["last_kind"] == "damping"


def test_a_kick_ends_in_damping(tmp_path: Path) -> None:
    """In the air a limb may swing faster than the limit: the run trips, and the joints are damped."""
    path, _ = imported(tmp_path, kicks=True)
    with deal_hw.emulate("h1", transport="zenoh", port="tcp/127.0.0.1:0", nominal=True) as robot:
        done = deal_hw.deploy(
            "h1",
            port=robot.port,
            link=ZENOH,
            policy=path,
            out=tmp_path,
            seconds=8.0,
            crane=HUNG,
            trust_calibration=True,
        )
    assert done.outcome is Outcome.TRIPPED and done.exit_code == 3
    assert "knee_joint' moves at" in done.episodes[-1].reason and done.episodes[-1].passive_confirmed
    assert robot.truth["commands"]["last_kind"] == "damping"
