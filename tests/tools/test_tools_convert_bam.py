"""The converter of bam's servo logs: arrays, a model by the data sheet, and one set-up for each P gain."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import convert_bam
import mujoco
import numpy as np
import pytest

from deal_hw.data.importing.npz_source import read_npz
from deal_hw.errors import DealHwError
from deal_hw.sim.parameters.yaml_space import parse_space
from deal_hw.sim.recordings.setups import read_setups


def log(path: Path, kp: int, name: str, *, on_s: float = 6.0, **other: Any) -> Path:
    """Write a raw log of 6 s at 200 Hz whose motor goes off after ``on_s``."""
    time = np.arange(0.0, 6.0, 0.005)
    entries = [
        {
            "position": 0.5 * np.sin(t),
            "speed": 0.5 * np.cos(t),
            "load": 3,
            "input_volts": 7.3,
            "temp": 28,
            "timestamp": t,
            "goal_position": np.sin(t),
            "torque_enable": bool(t < on_s),
        }
        for t in time
    ]
    rig = {"mass": 0.49, "length": 0.1, "kp": kp, "vin": 7.4, "motor": "xl330", "trajectory": name}
    path.write_text(json.dumps({**rig, **other, "entries": entries}))
    return path


def test_logs_become_recordings_of_one_servo(tmp_path: Path) -> None:
    """Arrays as logged while the motor was on; a lift that ends after 1.5 s is left out."""
    logs = [
        log(tmp_path / "a.json", 100, "sin_sin"),
        log(tmp_path / "b.json", 400, "sin_sin", on_s=4.0),
        log(tmp_path / "c.json", 400, "lift_and_drop", on_s=1.5),
    ]
    out = tmp_path / "out"
    assert convert_bam.main([*map(str, logs), "--out", str(out)]) == 0
    assert sorted(p.name for p in out.glob("*.npz")) == ["kp100-sin_sin.npz", "kp400-sin_sin.npz"]
    cut = read_npz(out / "kp400-sin_sin.npz")
    assert cut.column("time")[-1] == pytest.approx(3.995)
    np.testing.assert_allclose(cut.column("goal"), np.sin(cut.column("time")))
    np.testing.assert_allclose(cut.column("position"), 0.5 * np.sin(cut.column("time")))
    model = mujoco.MjModel.from_xml_path(str(out / "pendulum.xml"))
    # 0.52 N·m at 5 V are 0.7696 at 7.4 V; back-EMF 0.52 / 10.8; duty 4096 / (2 pi) / (256 * 885) * 400.
    assert model.actuator_forcerange[0] == pytest.approx([-0.7696, 0.7696])
    assert model.dof_damping[0] == pytest.approx(0.04815, rel=1e-3)
    assert model.actuator_gainprm[0, 0] == pytest.approx(0.8858, rel=1e-3)
    # Hanging at 0: gravity pulls it back.
    data = mujoco.MjData(model)
    data.qpos[0] = 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_bias[0] == pytest.approx(0.49 * 9.81 * 0.1 * np.sin(0.5), rel=1e-6)


def test_each_gain_is_a_set_up(tmp_path: Path) -> None:
    """The stiffness is proportional to the P gain; the model's own is that of 400."""
    logs = [log(tmp_path / f"{kp}.json", kp, "sin_sin") for kp in (100, 400, 800)]
    out = tmp_path / "out"
    assert convert_bam.main([*map(str, logs), "--out", str(out)]) == 0
    model = mujoco.MjModel.from_xml_path(str(out / "pendulum.xml"))
    space = parse_space((out / "parameters.yaml").read_text(), model)
    assert space.names == (
        "servo.servo_stiffness",
        "servo.servo_effort_limit",
        "shaft.damping",
        "shaft.frictionloss",
        "shaft.armature",
        "shaft.encoder_bias",
    )
    setups = read_setups(out / "setups.yaml")
    assert [setups.of(f"kp{kp}-sin_sin.npz") for kp in (100, 400, 800)] == ["kp100", "", "kp800"]
    text = (out / "setups.yaml").read_text()
    assert "0.221443" in text and "1.771544" in text


@pytest.mark.parametrize(
    ("other", "message"),
    [({"motor": "mx64"}, "the servo is mx64"), ({"vin": None}, "cannot be read as a raw log")],
)
def test_other_logs_are_refused(tmp_path: Path, other: dict[str, Any], message: str) -> None:
    """A servo that the model does not describe, and a file without a gain."""
    with pytest.raises(DealHwError, match=message):
        convert_bam.read_log(log(tmp_path / "a.json", 100, "sin_sin", **other))
    assert convert_bam.main([str(tmp_path / "a.json"), "--out", str(tmp_path / "out")]) == 1


def test_logs_of_two_weights_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One model has one weight."""
    logs = [log(tmp_path / "a.json", 100, "sin_sin"), log(tmp_path / "b.json", 100, "sin_sin", mass=0.3)]
    assert convert_bam.main([*map(str, logs), "--out", str(tmp_path / "out")]) == 1
    assert "2 weights" in capsys.readouterr().err
