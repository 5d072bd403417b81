"""The converter of the UR10e's recordings: currents become torques, and the arm hangs as its URDF says."""

from __future__ import annotations

from pathlib import Path

import convert_ur10e
import mujoco
import numpy as np
import pytest
import yaml

from deal_hw.data.importing.columns import parse_column_map
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.sim.parameters.yaml_space import parse_space


def log(path: Path, columns: int = 31, amplitude: float = 0.4) -> Path:
    """Write 4 s at 100 Hz; joint k of 0 to 5 moves from 2 s to 3 s and has a current of k + 1 A."""
    time = np.arange(400) / 100
    moving = (time >= 2) & (time < 3)
    shift = amplitude * np.where(moving, np.sin(2 * np.pi * time), 0.0)
    rows = np.zeros((400, columns))
    rows[:, 0] = 500.0 + time
    rows[:, 1:7] = shift[:, None] + np.arange(6)
    rows[:, 7:13] = np.gradient(shift, time)[:, None]
    rows[:, 13:19] = np.arange(1, 7)
    np.savetxt(path, rows, delimiter=",", fmt="%.4f")
    return path


@pytest.fixture
def arm(tmp_path: Path) -> mujoco.MjModel:
    """Return the model that the converter writes."""
    assert convert_ur10e.main([str(log(tmp_path / "a.csv")), "--out", str(tmp_path)]) == 0
    return mujoco.MjModel.from_xml_path(str(tmp_path / "ur10e.xml"))


def test_currents_become_torques_and_standstill_is_cut(tmp_path: Path) -> None:
    """Half a second of rest stays on both sides of the motion."""
    out = tmp_path / "out"
    assert convert_ur10e.main([str(log(tmp_path / "20sec.csv")), "--out", str(out)]) == 0
    found = read_npz(out / "20sec.npz")
    time = found.column("time") - 500.0
    assert time[0] == pytest.approx(1.5, abs=0.02)
    assert time[-1] == pytest.approx(3.5, abs=0.02)
    torque = found.array("torque")
    np.testing.assert_allclose(torque[0], [11.98, 2 * 11.98, 3 * 9.84, 4 * 10.76, 5 * 10.76, 6 * 10.76])
    np.testing.assert_allclose(found.array("position")[0], np.arange(6.0), atol=1e-4)


def test_the_column_map_and_the_parameters_fit_the_model(arm: mujoco.MjModel, tmp_path: Path) -> None:
    """Torques of all joints, and 27 parameters."""
    columns = parse_column_map(yaml.safe_load((tmp_path / "columns.yaml").read_text()))
    assert [joint.name for joint in columns.joints] == [arm.joint(i).name for i in range(arm.njnt)]
    space = parse_space((tmp_path / "parameters.yaml").read_text(), arm)
    assert len(space) == 27
    low, high = space.low[-1], space.high[-1]
    assert (space.names[-1], low, high) == ("wrist_3.mass", 0.05, 3.0)


def test_the_arm_is_that_of_the_urdf(arm: mujoco.MjModel) -> None:
    """Links stand upright at a lift of -pi / 2; gravity acts on what is beside the axis."""
    data = mujoco.MjData(arm)
    data.qpos[1] = -np.pi / 2
    mujoco.mj_forward(arm, data)
    # 0.181 to the shoulder, 0.613 and 0.571 of the links; sideways 0.176 - 0.137 and 0.135 of the wrist.
    np.testing.assert_allclose(data.body("wrist_1").xpos, [0.0, 0.039, 1.365], atol=1e-9)
    np.testing.assert_allclose(data.body("wrist_2").xpos, [0.0, 0.174, 1.365], atol=1e-9)
    # Upright, only wrist 2 and 3 are beside the axis of the lift, by 0.12 m. Stretched out, every link is.
    beside = 0.12 * (1.96 + 0.202)
    assert abs(data.qfrc_bias[1]) == pytest.approx(9.81 * beside, rel=1e-6)
    data.qpos[1] = 0.0
    mujoco.mj_forward(arm, data)
    along = 12.93 * 0.3065 + 3.87 * (0.613 + 0.2855) + (1.96 + 1.96 + 0.202) * (0.613 + 0.571)
    assert abs(data.qfrc_bias[1]) == pytest.approx(9.81 * along, rel=1e-6)
    assert data.qfrc_bias[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("columns", "amplitude", "match"),
    [(19, 0.4, "it has 19 columns, not 31"), (31, 0.0, "no joint is faster than 0.02 rad/s")],
)
def test_other_files_are_refused(
    columns: int, amplitude: float, match: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The oldest recordings lack desired torques; some poses only stand."""
    path = log(tmp_path / "a.csv", columns, amplitude)
    assert convert_ur10e.main([str(path), "--out", str(tmp_path / "out")]) == 1
    assert match in capsys.readouterr().err


def test_a_file_that_is_no_table_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The message names the file."""
    (tmp_path / "a.csv").write_text("time,position\n0,0\n")
    assert convert_ur10e.main([str(tmp_path / "a.csv"), "--out", str(tmp_path / "out")]) == 1
    assert "a.csv is not a recording of the UR10e" in capsys.readouterr().err
