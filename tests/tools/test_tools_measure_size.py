"""Arms of any size for calibration's cost: their hidden truths, and a tiny one calibrated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from measure_size import BIAS_RAD, FACTORS, main, make_arm, words, write_arm

from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.parameters.yaml_space import read_space


@pytest.mark.parametrize(("joints", "parameters"), [(1, 6), (2, 11), (7, 41), (14, 82)])
def test_an_arm_is_its_model_with_other_numbers(joints: int, parameters: int, tmp_path: Path) -> None:
    """Truths lie within their factors of what the model says, and the file of parameters names just these."""
    robot, text = make_arm(joints, 3)
    again, other = make_arm(joints, 3)[0], make_arm(joints, 4)[0]
    assert robot == again and robot.truth != other.truth
    assert len(robot.truth) == parameters
    model, truth = (mujoco.MjModel.from_xml_string(mjcf) for mjcf in (robot.model, robot.robot))
    assert model.njnt == model.nu == truth.nu == joints
    (tmp_path / "robot.xml").write_text(robot.model)
    (tmp_path / "params.yaml").write_text(text)
    space = read_space(tmp_path / "params.yaml", compile_mjcf(tmp_path / "robot.xml"))
    assert set(space.names) == set(robot.truth)
    for parameter in space:
        value = robot.truth[parameter.name]
        assert parameter.low < value < parameter.high
        if not parameter.name.endswith("encoder_bias"):
            assert abs(np.log(value / parameter.nominal)) <= np.log(max(FACTORS.values())) + 1e-9


def test_what_is_hidden_is_in_the_robot() -> None:
    """A bias is where an encoder reads when its joint stands at zero; the second link's mass is known."""
    robot = make_arm(7, 0)[0]
    model, truth = (mujoco.MjModel.from_xml_string(mjcf) for mjcf in (robot.model, robot.robot))
    for k in range(7):
        name = f"l{k + 1}"
        assert truth.qpos0[k] == pytest.approx(robot.truth[f"{name}.encoder_bias"])
        assert abs(truth.qpos0[k]) <= BIAS_RAD and model.qpos0[k] == 0.0
        assert truth.dof_damping[k] == pytest.approx(robot.truth[f"{name}.damping"])
        assert truth.actuator_gainprm[k, 0] == pytest.approx(robot.truth[f"{name}.servo_stiffness"])
    data = [mujoco.MjData(m) for m in (model, truth)]
    for m, d in zip((model, truth), data, strict=True):
        mujoco.mj_forward(m, d)
    # The same pose: a bias changes what is read, not where the arm is.
    np.testing.assert_allclose(data[0].xpos, data[1].xpos, atol=1e-12)
    assert truth.body("l2_link").mass[0] == model.body("l2_link").mass[0]
    assert truth.body("l3_link").mass[0] == pytest.approx(robot.truth["l3_link.mass"])


def test_a_model_may_lack_what_the_robot_has(tmp_path: Path) -> None:
    """The same robot behind a model without dry friction; masses and biases are of nobody's interest."""
    whole, (robot, text) = make_arm(7, 0)[0], make_arm(7, 0, lacking=True)
    assert robot.robot == whole.robot and not text
    model, own = (mujoco.MjModel.from_xml_string(of.model) for of in (robot, whole))
    assert not model.dof_frictionloss.any() and own.dof_frictionloss.all()
    np.testing.assert_array_equal(model.dof_damping, own.dof_damping)
    kinds = {name.split(".")[1] for name in robot.truth}
    assert kinds == {"servo_stiffness", "damping", "frictionloss", "armature"} and len(robot.truth) == 28
    _, arguments = write_arm(tmp_path, 7, 0, 6.0, lacking=True)
    assert "--parameters" not in arguments and (tmp_path / "robot.xml").read_text() == robot.model


def test_recordings_have_the_length_that_is_asked_for(tmp_path: Path) -> None:
    """6 s are two recordings of 3 s at 200 Hz; what judges has at least 4 s."""
    write_arm(tmp_path, 1, 0, 6.0)
    texts = [(tmp_path / f"{name}.csv").read_text() for name in ("fit1", "fit2", "held-out")]
    assert [len(text.splitlines()) - 1 for text in texts] == [600, 600, 800]


def test_a_stopped_calibration_is_said() -> None:
    """The row of a run that reached its limit before any fit was shown."""
    row: dict[str, Any] = {
        "joints": 7,
        "parameters": 41,
        "fitted_s": 60.0,
        "seed": 0,
        "seconds": 600.0,
        "cpu_s": 900.0,
        "peak_mib": 500.0,
        "load_before": 1.0,
        "load_after": 2.0,
        "error": "",
        "stopped": True,
        "said": ["a"],
    }
    assert words(row).endswith("load 1.0 to 2.0, stopped at the limit\n  a")


@pytest.mark.slow
def test_a_tiny_arm_is_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One joint, 6 s: seconds, memory and held-out error are in the row, and the profile is shown."""
    out, profile = tmp_path / "size.json", tmp_path / "size.prof"
    options = "--threads 1 --no-report --no-advise --population 8 --generations 2"
    arguments = ["--joints", "1", "--seconds", "6", "--options", options, "--profile", str(profile)]
    assert main([*arguments, "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert row["error"] == "" and not row["stopped"] and row["parameters"] == 6
    assert row["seconds"] > 0 and row["peak_mib"] > 10
    assert row["heldout_rmse"]["calibrated"] < row["heldout_rmse"]["nominal"]
    assert "ncalls" in capsys.readouterr().out
