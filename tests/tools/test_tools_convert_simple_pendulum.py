"""The converter of the pendulum on an AK80-6: torques between rows, one rate, the swing-up alone."""

from __future__ import annotations

from pathlib import Path

import convert_simple_pendulum
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from deal_hw.data.importing.columns import parse_column_map
from deal_hw.data.importing.npz_source import read_npz
from deal_hw.types import FloatArray


def log(folder: Path, name: str, time: FloatArray, position: FloatArray, torque: FloatArray) -> Path:
    """Write data_measured.csv of a controller."""
    path = folder / name / "data_measured.csv"
    path.parent.mkdir(parents=True)
    rows = np.stack([time, position, np.gradient(position, time), torque], axis=1)
    np.savetxt(path, rows, delimiter=",", header="time,position,velocity,torque", comments="")
    return path


def swing(rate_hz: float, seconds: float = 3.0) -> tuple[FloatArray, FloatArray]:
    """Return time and position of a swing that needs no hand."""
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    return time, 0.5 * np.sin(4.0 * time)


def test_the_torque_of_a_row_is_the_next_reading(tmp_path: Path) -> None:
    """The drive answers with the torque from before the command."""
    time, position = swing(200.0)
    torque = np.arange(time.size) / 1000
    path = log(tmp_path, "control_method_sac", time, position, torque)
    assert convert_simple_pendulum.main([str(path), "--out", str(tmp_path)]) == 0
    found = read_npz(tmp_path / "sac.npz")
    np.testing.assert_allclose(found.column("time"), time[:-1])
    np.testing.assert_allclose(found.column("position"), position[:-1])
    np.testing.assert_allclose(found.column("torque"), torque[1:])


@given(st.floats(300, 600))
def test_faster_recordings_are_thinned_and_keep_the_impulse(rate_hz: float) -> None:
    """The mean torques of 5 ms carry the impulse of all readings."""
    time, _ = swing(rate_hz)
    torque = np.sin(3 * time)
    stamps, mean = convert_simple_pendulum.mean_torque(time, torque)
    np.testing.assert_allclose(np.diff(stamps), 0.005)
    impulse = np.sum(torque[1:] * np.diff(time))
    left = time[-1] - stamps[-1]
    assert 0 <= left <= 0.005 + 1e-9
    assert np.sum(mean) * 0.005 == pytest.approx(impulse, abs=0.0051)


@pytest.mark.parametrize("top", [np.pi, -np.pi, 5 * np.pi])
def test_a_recording_ends_where_the_pendulum_arrives(top: float, tmp_path: Path) -> None:
    """It passes the top at 1 s, and stays there from 2 s on; then hands push it."""
    time = np.arange(800) / 200
    position = np.interp(time, [0.0, 1.0, 1.3, 2.0, 3.0, 4.0], [top - 3, top, top + 2, top, top, top - 9])
    found = convert_simple_pendulum.read_log(log(tmp_path, "sac", time, position, position))
    # From 2 rad beside the top at 1.3 s it comes to 0.2 rad after 0.9 of the next 0.7 s.
    assert found["time"][-1] == pytest.approx(1.3 + 0.9 * 0.7, abs=0.01)
    assert all(values.size == found["time"].size for values in found.values())


def test_a_recording_that_does_not_arrive_is_kept(tmp_path: Path) -> None:
    """All of its rows but the last one, which has no torque."""
    time, position = swing(200.0)
    assert convert_simple_pendulum.read_log(log(tmp_path, "a", time, position, position))["time"].size == 599


def test_the_model_has_the_weight_and_the_rod(tmp_path: Path) -> None:
    """It is pulled back by m g l sin(q), and both turn with the rotor behind the gear."""
    time, position = swing(200.0)
    path = log(tmp_path, "control_method_sac", time, position, position)
    assert convert_simple_pendulum.main([str(path), "--out", str(tmp_path)]) == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "simple_pendulum.xml"))
    data = mujoco.MjData(model)
    data.qpos[0] = 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_bias[0] == pytest.approx(9.81 * (0.546 * 0.5 + 0.13 * 0.25) * np.sin(0.5), rel=1e-4)
    # 0.546 * 0.5² + 0.13 * 0.5² / 3 of weight and rod, 6.0719e-5 * 36 of the rotor.
    inertia = np.zeros((1, 1))
    mujoco.mj_fullM(model, data, inertia)
    assert inertia[0, 0] == pytest.approx(0.1365 + 0.010833 + 0.002186, rel=1e-3)
    (joint,) = parse_column_map(yaml.safe_load((tmp_path / "columns.yaml").read_text())).joints
    assert joint.name == model.joint(0).name


def test_other_recordings_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Another weight by the file's name, and 50 rows a second, which have another rate than the others."""
    slow = log(tmp_path, "control_method_ilqr", *swing(50.0), np.zeros(150))
    assert convert_simple_pendulum.main([str(slow), "--out", str(tmp_path / "out")]) == 1
    assert "has 50 rows a second; give recordings of 200 or more" in capsys.readouterr().err
    other = slow.rename(slow.with_name("data_measured_1kg.csv"))
    assert convert_simple_pendulum.main([str(other), "--out", str(tmp_path / "out")]) == 1
    assert "others have another weight" in capsys.readouterr().err
