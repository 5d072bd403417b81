"""What `deal-hw calibrate --model` says next: what to record where a parameter stayed open."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.cli.main import EXIT_OK, main

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" armature="0.01" damping="0.1" frictionloss="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="8" kv="0.1" forcerange="-20 20"/></actuator>
</mujoco>
"""
PARAMETERS = """
parameters:
  - {kind: dof_armature, elements: hinge}
  - {kind: dof_damping, elements: hinge}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, its parameters, and 5 s of so slow a motion that inertia hardly shows."""
    folder = tmp_path_factory.mktemp("pendulum")
    (folder / "robot.xml").write_text(PENDULUM, encoding="utf-8")
    (folder / "params.yaml").write_text(PARAMETERS, encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    with (folder / "rec.csv").open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["time", "hinge_pos", "hinge_cmd"])
        for t in np.arange(0.0, 5.0, 0.02):
            target = 0.6 * np.sin(2 * np.pi * 0.3 * t)
            out.writerow([t, data.qpos[0] + 1e-3 * rng.standard_normal(), target])
            data.ctrl[0] = target
            mujoco.mj_step(model, data, 10)
    return folder


@pytest.mark.slow
def test_open_parameters_come_with_advice(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A slow motion leaves the armature open: output, result and report say which motion would show it."""
    words = [
        "calibrate",
        "--model",
        str(folder / "robot.xml"),
        "--data",
        str(folder / "rec.csv"),
        "--parameters",
        str(folder / "params.yaml"),
        "--population",
        "16",
        "--generations",
        "6",
        "--threads",
        "1",
        "--residual-std",
        "0.03",
        "--holdout-part",
        "0",
    ]
    assert main([*words, "--out", str(tmp_path)]) == EXIT_OK
    reported = " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "calibration" / "result.json").read_text())
    advice = {row["parameter"]: row for row in found["advice"]}
    assert found["parameters"]["hinge.armature"]["verdict"] != "identifiable"
    row = advice["hinge.armature"]
    assert row["std_after"] < 0.7 * row["std"]
    assert row["sentence"].startswith("record 4 s of ")
    assert f"next: {row['sentence']}" in reported
    page = (tmp_path / "calibration" / "report.html").read_text()
    assert "What to record next" in page and row["sentence"] in page
    assert (
        {"hinge.armature"}
        <= set(advice)
        <= {name for name, p in found["parameters"].items() if p["verdict"] != "identifiable"}
    )
