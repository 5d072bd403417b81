"""A floating robot from its joints and its IMU alone, recorded in an NPZ file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from deal_hw.cli.main import EXIT_ERROR, EXIT_OK, main
from deal_hw.data.recording.dataset import Dataset
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION
from deal_hw.drivers.go2.motions import FEET, sway
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.engine.tangent_coordinates import to_quaternion
from deal_hw.sim.recordings.target import TargetSensing, record_target

COLUMNS = """
time: time
position: q
target: q_des
orientation: {columns: [quaternion], order: wxyz}
gyro: {columns: [gyro]}
joints:
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of a swaying Go2 that is a fifth stiffer than its model, with noise."""
    folder = tmp_path_factory.mktemp("go2")
    robot = load_model(DESCRIPTION)
    actuators = DESCRIPTION.joint_names
    space = ParameterSpace([Parameter.around("k", "servo_stiffness", actuators, "N·m/rad", 40.0)])
    rng = np.random.default_rng(5)
    sensing = TargetSensing(joint_std=(1e-3,) * 12, orientation_std=4e-3, gyro_std=0.02, feet=FEET)
    made = record_target(
        robot, space, np.array([48.0]), sway(robot, rng, 4.0), seconds=4.0, sensing=sensing, rng=rng
    )
    episode = made.episode
    assert episode.reference is not None
    rotation = robot.rotation
    rows = np.clip(episode.sample, 0, len(episode.target) - 1)
    np.savez(
        folder / "rec.npz",
        time=episode.sample * episode.step_s,
        q=episode.position[:, robot.joints],
        q_des=episode.target[rows],
        quaternion=to_quaternion(episode.position[:, rotation], episode.reference),
        gyro=episode.velocity[:, rotation],
        joint_names=np.array(DESCRIPTION.joint_names),
    )
    (folder / "columns.yaml").write_text(COLUMNS + "".join(f"  - {j}\n" for j in DESCRIPTION.joint_names))
    entry = "{kind: servo_stiffness, elements: '*', group: together, name: k, nominal: 40, ratio: 2}"
    (folder / "params.yaml").write_text(f"parameters: [{entry}]\n")
    return folder


def command(folder: Path, *more: str) -> list[str]:
    """Return the arguments of a short calibration."""
    words = ["calibrate", "--model", str(DESCRIPTION.mjcf), "--data", str(folder / "rec.npz")]
    words += ["--columns", str(folder / "columns.yaml"), "--parameters", str(folder / "params.yaml")]
    words += ["--latency", "0", "--population", "12", "--generations", "8", "--no-refine", "--no-report"]
    return [*words, "--out", str(folder / "out"), "--quiet", "--threads", "1", *more]


def test_floating_robot_needs_feet(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing else says how fast the base moves."""
    assert main(command(folder)) == EXIT_ERROR
    assert "needs --feet" in capsys.readouterr().err


@pytest.mark.slow
def test_stiffness_is_found_from_joints_and_imu(folder: Path) -> None:
    """Within 3 % of the hidden 48 N·m/rad; the held-out error covers joints and orientation."""
    words = command(folder, "--fit-seconds", "2.5", "--window", "0.2", "--feet", *FEET)
    assert main(words) == EXIT_OK
    found = json.loads((folder / "out" / "calibration" / "result.json").read_text())
    assert found["parameters"]["k"]["estimate"] == pytest.approx(48.0, rel=0.03)
    rmse = found["provenance"]["heldout_rmse"]
    assert rmse["mean"]["calibrated"] < rmse["mean"]["nominal"]
    assert len(rmse["by_coordinate"]["null"]) == 15


@pytest.mark.slow
def test_a_dataset_keeps_the_base_of_a_floating_robot(folder: Path, tmp_path: Path) -> None:
    """IMU, feet and MJCF come with it: the same stiffness as from the file itself, and inspect shows it."""
    yaml, dataset = tmp_path / "robot.yaml", tmp_path / "run" / "dataset"
    new = ["robot", "new", str(DESCRIPTION.mjcf), "--out", str(yaml), "--name", "dog", "--feet", *FEET]
    assert main([*new, "--control-rate", "50", "--state-rate", "250"]) == EXIT_OK
    words = ["data", "import", str(folder / "rec.npz"), "--columns", str(folder / "columns.yaml")]
    assert main([*words, "--robot", str(yaml), "--out", str(dataset)]) == EXIT_OK
    episode = Dataset.open(dataset).read(0).trajectory
    with np.load(folder / "rec.npz") as recorded:
        assert episode.body is not None
        assert np.allclose(episode.body.angular_velocity, recorded["gyro"])
        assert np.allclose(np.abs(np.sum(episode.body.orientation * recorded["quaternion"], axis=1)), 1)
    words = command(folder, "--fit-seconds", "2.5", "--window", "0.2")
    at = words.index("--model")
    words[at : words.index("--parameters")] = [str(dataset)]
    assert main([*words, "--out", str(tmp_path / "run")]) == EXIT_OK
    found = json.loads((tmp_path / "run" / "calibration" / "result.json").read_text())
    assert found["parameters"]["k"]["estimate"] == pytest.approx(48.0, rel=0.03)
    recording = str(dataset / "episodes" / "000000.mcap")
    assert main(["inspect", recording, "--save", str(tmp_path / "a.rrd"), "--quiet"]) == EXIT_OK
