"""``deal-hw calibrate --model`` where a stage fails: the reason is printed, and no traceback ends the run."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.cli.main import EXIT_OK, main

HINGE = """
<mujoco model="hinge">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody><body>
    <joint name="hinge" axis="0 1 0" armature="0.002" damping="{damping}"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.01" mass="0.05"/>
  </body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="8" kv="0"/></actuator>
</mujoco>
"""
DAMPING = "parameters: [{kind: dof_damping, elements: hinge}]"
Calibrated = Callable[..., tuple[int, str, Path]]


def recording(seconds: float, damping: float, seed: int) -> str:
    """Return a CSV of set-point steps at 100 Hz, noise 0.3 mrad."""
    model = mujoco.MjModel.from_xml_string(HINGE.format(integrator="implicitfast", damping=damping))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    rows, wanted = ["time,hinge_pos,hinge_cmd"], 0.0
    for k in range(round(100 * seconds)):
        wanted = rng.uniform(-0.8, 0.8) if k % 20 == 5 else wanted
        rows.append(f"{0.01 * k:.3f},{data.qpos[0] + 3e-4 * rng.standard_normal():.7f},{wanted:.7f}")
        data.ctrl[0] = wanted
        mujoco.mj_step(model, data, 5)
    return "\n".join(rows) + "\n"


@pytest.fixture
def calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Calibrated:
    """Return a function that calibrates a hinge of damping 0.1 and gives exit code, words and folder."""

    def run(parameters: str, *more: str, integrator: str = "implicitfast") -> tuple[int, str, Path]:
        (tmp_path / "hinge.xml").write_text(HINGE.format(integrator=integrator, damping="0.1"))
        (tmp_path / "params.yaml").write_text(parameters + "\n")
        if not (tmp_path / "rec.csv").exists():
            (tmp_path / "rec.csv").write_text(recording(4.0, 0.1, 1))
        line = ["calibrate", "--model", str(tmp_path / "hinge.xml"), "--data", str(tmp_path / "rec.csv")]
        line += ["--parameters", str(tmp_path / "params.yaml"), "--population", "16", "--generations", "6"]
        line += ["--threads", "1", "--no-report", "--no-advise", "--out", str(tmp_path / "out"), *more]
        code = main(line)
        printed = capsys.readouterr()
        return code, " ".join((printed.err + printed.out).split()), tmp_path / "out" / "calibration"

    return run


UNSTABLE = "parameters: [{kind: servo_stiffness, elements: servo, nominal: 3.0e+5, range: [2, 1.0e+6]}]"


@pytest.mark.parametrize("search", ["eki", pytest.param("deal", marks=pytest.mark.slow)])
def test_a_local_fit_that_diverges_is_said_and_leaves_it_to_the_search(
    calibrated: Calibrated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, search: str
) -> None:
    """The nominal gain is unstable at this step. That is printed, and the search finds real numbers."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log of its own there.
    code, printed, folder = calibrated(
        UNSTABLE, "--method", "default", "--search", search, integrator="Euler"
    )
    assert code == EXIT_OK and "diverge" in printed
    result = json.loads((folder / "result.json").read_text())
    estimate = result["parameters"]["servo.servo_stiffness"]["estimate"]
    assert math.isfinite(result["chi2"]) and estimate == pytest.approx(8.0, rel=0.5)


def test_a_held_out_recording_worse_than_nominal_is_red(calibrated: Calibrated, tmp_path: Path) -> None:
    """The held-out robot is the nominal one, the fitted one another: the verdict says not to use it."""
    (tmp_path / "rec.csv").write_text(recording(4.0, 0.3, 1))
    (tmp_path / "other.csv").write_text(recording(3.0, 0.1, 2))
    code, printed, folder = calibrated(DAMPING, "--holdout", str(tmp_path / "other.csv"))
    assert code == EXIT_OK and "Traceback" not in printed
    assert "red: " in printed and "is worse. Do not use it. Check units" in printed
    # Other programs read it in the result.
    result = json.loads((folder / "result.json").read_text())
    assert result["verdict"] == "red" and "Do not use it" in result["verdict_reason"]
