"""The cart-pole's converter and its score: repaired angles, windows and errors by hand."""

from __future__ import annotations

from pathlib import Path

import convert_cartpole
import mujoco
import numpy as np
import pytest
import score_cartpole

from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.load import load_tables
from deal_hw.types import FloatArray

HEAD = "# CartPole\n#\ntime,sent,angle_raw,angle,position,actualMotorSave,Q,measurement\n"


def log(folder: Path, counts: list[int]) -> Path:
    """Write a log of 20 ms in the source's layout, a row per count of the potentiometer."""
    rows = [
        f"{1 + 0.0203 * k},{5 + 0.02 * k},{count},{np.angle(np.exp(0.3j * k))},{0.01 * k},-2153.845,0.5,"
        '" Idle (a, b)"\n'
        for k, count in enumerate(counts)
    ]
    path = folder / "Experiment-0.csv"
    path.write_text(HEAD + "".join(rows), encoding="utf-8")
    return path


def test_an_angle_is_repaired_and_its_command_is_in_newtons(tmp_path: Path) -> None:
    """1209.82 counts hang at -pi, upwards from there; counts at the gap are left out, commands are not."""
    counts = [1210, 1300, 2500, 3700, 4086, 4095, 0, 8, 200, 1210] + [1210] * 15
    out = tmp_path / "out"
    assert convert_cartpole.main([str(log(tmp_path, counts)), "--out", str(out)]) == 0
    model = mujoco.MjModel.from_xml_path(str(out / "cartpole.xml"))
    assert model.joint("cart").armature[0] == 1.4
    (table,) = load_tables(
        out / "Experiment-0.npz", read_column_map(out / "columns.yaml"), joints=("cart", "pole")
    )
    assert table.units == ("m", "rad") and table.actuated == ("cart",)
    np.testing.assert_allclose(table.time_s[:6], [0, 0.02, 0.04, 0.06, 0.08, 0.14], atol=1e-9)
    assert len(table.command_s) == 25
    # -(-2153.845) / 4307.69 of 2.62 N.
    np.testing.assert_allclose(table.target, 1.31, atol=1e-5)
    np.testing.assert_allclose(table.position[0, 1], 0.18 * 0.001467 - np.pi)
    # 4086 is (4086 - 1209.82) 0.001467 - pi = 1.078; 8 lies behind the gap: (8 - 1209.82) 0.001467 + pi.
    np.testing.assert_allclose(table.position[4:6, 1], [1.07776, 1.37852], atol=1e-4)


def test_a_held_reading_before_the_gap_is_no_angle(tmp_path: Path) -> None:
    """118 to 12 counts, then 12 again: left out of the fit, kept in the score. A slow pole repeats itself."""
    fast, slow = [360, 233, 118, 12, 12, 4092, 4024, 3966], [40, 30, 20, 12, 12, 2, 4080]
    counts = [2000] * 5 + fast + slow + [2000] * 5
    out = tmp_path / "out"
    assert convert_cartpole.main([str(log(tmp_path, counts)), "--out", str(out)]) == 0
    with np.load(out / "Experiment-0.npz") as file:
        np.testing.assert_allclose(np.setdiff1d(file["every_time"], file["time"]), [5 + 0.02 * 9])
        assert len(file["every_time"]) == len(counts) - 2
    assert score_cartpole.read(out / "Experiment-0.npz").measured.sum() == len(counts) - 2


def test_the_gap_can_be_kept(tmp_path: Path) -> None:
    """2 counts are (2 - 1209.82) 0.001467 - pi = -4.913 rad, one turn on behind 4086 counts."""
    counts = [1210, 2500, 3700, 4086, 4095, 2, 8, 200] + [1210] * 15
    out = tmp_path / "out"
    assert convert_cartpole.main([str(log(tmp_path, counts)), "--out", str(out), "--keep-gap"]) == 0
    with np.load(out / "Experiment-0.npz") as file:
        assert len(file["time"]) == len(file["every_time"]) == len(counts)
        np.testing.assert_allclose(
            file["pole_angle"][3:6], [1.07776, 1.09097, -4.91346 + 2 * np.pi], atol=1e-4
        )


def test_as_logged_keeps_angle_and_power(tmp_path: Path) -> None:
    """The importer unwraps the log's angle, and the map says what a power of 1 is."""
    path = log(tmp_path, [1210] * 60)
    assert convert_cartpole.main([str(path), "--out", str(tmp_path), "--as-logged", "--rotor", "0"]) == 0
    printed: list[str] = []
    (table,) = load_tables(
        tmp_path / "Experiment-0.npz", read_column_map(tmp_path / "columns.yaml"), say=printed.append
    )
    assert any("the angle of pole jumps by a full turn 3 times" in text for text in printed)
    np.testing.assert_allclose(np.diff(table.position[:, 1]), 0.3, atol=1e-9)
    np.testing.assert_allclose(table.target, 1.31)


def test_other_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A column that is missing is named."""
    path = tmp_path / "a.csv"
    path.write_text("time,angle\n0,1\n", encoding="utf-8")
    assert convert_cartpole.main([str(path), "--out", str(tmp_path)]) == 1
    assert "has no channel 'sent'" in capsys.readouterr().err


def recording(position: FloatArray) -> score_cartpole.Recording:
    """Return a recording without commands."""
    return score_cartpole.Recording(position, np.zeros(1), np.zeros(1))


def test_windows_start_between_measured_samples_and_lie_back_to_back() -> None:
    """Of 30 periods without the 9th: windows of five start at 2, 11, 16 and 21."""
    position = np.zeros((30, 2))
    position[8] = np.nan
    assert score_cartpole.starts(recording(position), 5).tolist() == [2, 11, 16, 21]
    assert score_cartpole.starts(recording(position), 9).tolist() == [2, 11, 20]


def test_a_start_state_is_that_of_a_quadratic() -> None:
    """0.1 + 0.5 t - 3 t^2 at its middle, exactly."""
    t = 0.02 * np.arange(-2, 3)
    position = np.stack([0.1 + 0.5 * t - 3 * t**2, 2.0 * t], axis=1)
    found, velocity = score_cartpole.start_state(recording(position), 2)
    np.testing.assert_allclose(found, [0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(velocity, [0.5, 2.0], atol=1e-12)


def test_errors_of_the_true_model_and_of_a_wrong_one(tmp_path: Path) -> None:
    """With 5 ms of latency the model predicts itself to what its start states leave, nothing else does."""
    text = convert_cartpole.MODEL.format(rotor=1.4, force=2.62)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos = 0.0, 2.9
    force = np.repeat(np.random.default_rng(0).uniform(-2, 2, 30), 5)
    position = np.empty((150, 2))
    for k in range(150):
        position[k] = data.qpos
        for step in range(10):
            # The command of period k acts from its third step of 2 ms, 4 ms later.
            data.ctrl[0] = (force[k] if step >= 2 else force[max(k - 1, 0)]) / 2.62
            mujoco.mj_step(model, data)
    seen = score_cartpole.Recording(position, 0.02 * np.arange(150.0), force)
    right = score_cartpole.scores(model, 2.62, 0.004, seen)
    late = score_cartpole.scores(model, 2.62, 0.03, seen)
    still = score_cartpole.scores(None, 2.62, 0.0, seen)
    for k in range(2):
        assert right["0.2"][k] < 0.5 * late["0.2"][k] < 0.5 * still["0.2"][k]
    assert right["0.2"][0] < 0.3 and right["0.2"][1] < 6
