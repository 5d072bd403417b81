"""The files of the worked example read recordings with the columns of the public ones."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.data.checks.command_kind import command_kind
from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.load import load_tables
from deal_hw.findings import Severity
from deal_hw.sim.recordings.setups import read_setups

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "double_pendulum"
HEADER = (
    "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,pos_filt1,pos_filt2,vel_filt1,vel_filt2,"
    "tau_con1,tau_con2,tau_fric1,tau_fric2,tau_meas1,tau_meas2"
)


def test_the_double_pendulum(tmp_path: Path) -> None:
    """Torques of 0.8 N·m at the elbow, 500 times a second, swing both joints; each column has its place."""
    model = mujoco.MjModel.from_xml_path(str(FOLDER / "double_pendulum.xml"))
    data, rows = mujoco.MjData(model), []
    for k in range(1500):
        torque = 0.8 * np.array([0.5 * np.sin(0.015 * k), np.cos(0.02 * k)])
        seen = np.concatenate([data.qpos, data.qvel])
        rows.append(np.concatenate([[0.002 * k], seen, seen, torque, [0.0, 0.0], torque]))
        data.ctrl[:] = torque
        mujoco.mj_step(model, data, 2)
    recording = tmp_path / "trajectory_00.csv"
    np.savetxt(recording, rows, delimiter=",", header=HEADER, comments="")
    (table,) = load_tables(recording, read_column_map(FOLDER / "columns.yaml"))
    assert table.joint_names == tuple(model.joint(k).name for k in range(model.njnt))
    assert table.position == pytest.approx(np.array(rows)[:, 1:3])
    assert table.target == pytest.approx(np.array(rows)[:, 9:11])
    assert command_kind(table, servo=False).severity is not Severity.FAIL


def test_each_fitted_recording_has_its_zeros() -> None:
    """The page's set-ups name its recordings, whose zeros are searched at both joints."""
    setups = read_setups(FOLDER / "zeros.yaml")
    names = [f"trajectory_0{k}.csv" for k in (0, 1, 3, 5)]
    assert [setups.of(name) for name in names] == ["00", "01", "03", "05"]
    assert setups.of("trajectory_02.csv") == ""
    assert all(setup.encoder_bias == {"*": 0.3} for setup in setups.setups.values())
