"""Recorded efforts in a calibration: the sensor comes back, and with it the scale that no motion shows."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import pytest
from fakes.sine_arm import COLUMNS, MJCF, record

import deal_hw
from deal_hw.errors import ConfigurationError, InsufficientDataError

SENSOR = """parameters:
  - {kind: dof_damping, elements: elbow}
  - {kind: body_mass, elements: lower}
  - {kind: effort_gain, elements: elbow}
  - {kind: effort_bias, elements: elbow}
  - {kind: effort_delay, elements: elbow}
"""
STEP_S = 0.002


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(MJCF, encoding="utf-8")
    (tmp_path / "columns.yaml").write_text(COLUMNS, encoding="utf-8")
    return tmp_path


def _truth() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(MJCF)
    lower = spec.body("lower")
    lower.mass, lower.inertia = 0.62, lower.inertia * 0.62 / 0.5
    spec.joint("elbow").damping = [0.13, 0, 0]
    return spec.compile()


def _calibrate(folder: Path, parameters: str, data: Path, **more: object) -> deal_hw.Calibration:
    path = folder / "parameters.yaml"
    path.write_text(parameters, encoding="utf-8")
    return deal_hw.calibrate(
        folder / "arm.xml",
        data,
        columns=folder / "columns.yaml",
        parameters=path,
        method="default",
        latency=0.0,
        threads=1,
        **more,
    )


@pytest.mark.slow
def test_gain_bias_and_delay_of_a_torque_sensor_come_back(folder: Path) -> None:
    """A sensor that reports 1.12 times the torque of 4 ms ago plus 0.05 N·m, beside mass and damping."""
    data = record(_truth(), folder / "fit.csv", 1, gain=1.12, bias=0.05, delay_steps=2)
    found = _calibrate(folder, SENSOR, data)
    row = {r["parameter"]: r for r in found.rows()}
    assert row["elbow.effort_gain"]["estimate"] == pytest.approx(1.12, abs=0.006)
    assert row["elbow.effort_bias"]["estimate"] == pytest.approx(0.05, abs=0.006)
    assert row["elbow.effort_delay"]["estimate"] == pytest.approx(2 * STEP_S, abs=2e-4)
    assert row["lower.mass"]["estimate"] == pytest.approx(0.62, rel=2e-3)
    assert row["elbow.damping"]["estimate"] == pytest.approx(0.13, rel=0.02)
    assert all(r["verdict"] in ("identifiable", "") for r in row.values())
    assert found.report(folder).exists()


@pytest.mark.parametrize(
    ("gain", "words"),
    [
        (-1.0, r"'elbow' has the other sign than the model's torque .*multiply its column by -1"),
        (
            20.0,
            r"percent of the full torque, or a current\? .*effort_gain, elements: elbow, nominal: ",
        ),
    ],
)
def test_an_effort_with_another_sign_or_unit_is_refused(folder: Path, gain: float, words: str) -> None:
    """Before any fit, with what to write."""
    data = record(_truth(), folder / "fit.csv", 1, gain=gain)
    with pytest.raises(ConfigurationError, match=words):
        _calibrate(folder, SENSOR, data)


@pytest.mark.slow
def test_a_current_has_a_gain_of_its_own(folder: Path) -> None:
    """20 units of the recording for a newton metre: with that nominal value it is a sensor like others."""
    data = record(_truth(), folder / "fit.csv", 1, gain=20.0)
    text = SENSOR.replace(
        "{kind: effort_gain, elements: elbow}", "{kind: effort_gain, elements: elbow, nominal: 18}"
    )
    found = _calibrate(folder, text, data)
    row = {r["parameter"]: r["estimate"] for r in found.rows()}
    assert row["elbow.effort_gain"] == pytest.approx(20.0, rel=5e-3)


def test_recordings_without_efforts_are_refused(folder: Path) -> None:
    """A parameter of a sensor that nobody recorded."""
    columns = re.sub(r", effort: \w+", "", COLUMNS)
    (folder / "columns.yaml").write_text(columns, encoding="utf-8")
    data = record(_truth(), folder / "fit.csv", 1)
    with pytest.raises(
        InsufficientDataError, match=r"no recording has efforts .*name their columns as `effort`"
    ):
        _calibrate(folder, SENSOR, data)


def test_efforts_are_no_set_points(folder: Path) -> None:
    """A column of torques named as target of a servo is refused."""
    (folder / "columns.yaml").write_text(
        COLUMNS.replace("_cmd", "_x").replace("_torque", "_cmd").replace("_x", "_torque"), encoding="utf-8"
    )
    data = record(_truth(), folder / "fit.csv", 1)
    with pytest.raises(deal_hw.errors.DatasetError, match="look like efforts"):
        _calibrate(folder, SENSOR, data)
