"""The converter of the pendulum on an AK80-6: torques between rows, one rate, no pushes by hand."""

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


def test_a_push_by_hand_is_left_out(tmp_path: Path) -> None:
    """0.1 s around motion that neither the drive nor gravity makes; a fast swing of the drive stays."""
    time, position = swing(200.0)
    # 0.06 rad more within 0.03 s, from 1.5 s on: about 130 rad/s², 19 N·m.
    pushed = position + 0.06 * np.clip((time - 1.5) / 0.03, 0, 1)
    path = log(tmp_path, "pushed", time, pushed, np.full_like(time, 0.5))
    found = convert_simple_pendulum.read_log(path)
    gap = np.diff(found["time"])
    last = found["time"][np.argmax(gap)]
    assert 0.2 < gap.max() < 0.35
    assert 1.3 < last < 1.45
    assert np.sum(gap > 0.006) == 1
    driven = convert_simple_pendulum.read_log(log(tmp_path, "driven", time, pushed, np.full_like(time, 20.0)))
    assert driven["time"].size == time.size - 1


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
