"""`bench real`: methods on recordings of a robot nobody simulated, judged on what they have not seen."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.bench.settings import Real
from deal_hw.cli.bench import bench
from deal_hw.cli.main import main
from deal_hw.errors import ConfigurationError
from deal_hw.workflows.calibration.settings import Recordings

HINGE = """
<mujoco model="hinge">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" range="-2 2" limited="true" armature="0.01" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position name="hinge" joint="hinge" kp="12" kv="0.1" forcerange="-20 20"/></actuator>
</mujoco>
"""
PARAMETERS = "parameters:\n  - {kind: dof_damping, elements: hinge}\n"


@pytest.fixture
def hinge(tmp_path: Path) -> Recordings:
    """Return a model, its parameters and six seconds of a hinge whose damping is twice the model's."""
    model = mujoco.MjModel.from_xml_string(HINGE.format(damping="0.4"))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    time = np.arange(0.0, 6.0, 0.02)
    target = 0.3 * np.sin(2 * np.pi * np.outer(time, (0.5, 1.3, 2.1)) + (0.0, 1.0, 2.0)).sum(axis=1)
    data.qpos[0] = target[0]
    rows = ["time,hinge_pos,hinge_cmd"]
    for t, wanted in zip(time, target, strict=True):
        rows.append(f"{t:.3f},{data.qpos[0] + 3e-4 * rng.standard_normal():.7f},{wanted:.7f}")
        data.ctrl[0] = wanted
        for _ in range(10):
            mujoco.mj_step(model, data)
    (tmp_path / "hinge.xml").write_text(HINGE.format(damping="0.2"))
    (tmp_path / "hinge.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "params.yaml").write_text(PARAMETERS)
    return Recordings(
        model=tmp_path / "hinge.xml", data=(tmp_path / "hinge.csv",), parameters=tmp_path / "params.yaml"
    )


@pytest.mark.slow
def test_a_calibrated_model_predicts_unseen_motion_better_than_the_given_one(
    hinge: Recordings, tmp_path: Path
) -> None:
    """The rows say who fitted, how far off unseen motion is predicted, and what ended at a bound."""
    out = tmp_path / "real.json"
    settings = Real(
        recordings=hinge,
        methods=("nominal", "default"),
        seeds=(0,),
        out=out,
        heldout_window=0.5,
        population=30,
        generations=10,
        threads=1,
        quiet=True,
    )
    assert bench(settings) == 0
    rows = {row["method"]: row for row in json.loads(out.read_text())["rows"]}
    assert set(rows) == {"nominal", "default"}
    nominal, fitted = rows["nominal"], rows["default"]
    assert list(nominal["estimate"].values()) == [pytest.approx(0.2)]
    assert fitted["heldout_rmse_calibrated"] < 0.2 * fitted["heldout_rmse_nominal"]
    assert fitted["at_bound"] == [] and fitted["refined"]
    assert next(iter(fitted["estimate"].values())) == pytest.approx(0.4, rel=0.05)


def test_a_dataset_that_carries_its_robot(hinge: Recordings, tmp_path: Path) -> None:
    """The rows are of its robot, and of the episodes that are fitted and held out."""
    dataset = tmp_path / "dataset"
    # A comment makes another file of it.
    other = tmp_path / "other.csv"
    other.write_text("# again\n" + Path(hinge.data[0]).read_text())
    line = ["data", "import", str(hinge.data[0]), str(other), "--model", str(hinge.model)]
    assert main([*line, "--out", str(dataset)]) == 0
    out = tmp_path / "real.json"
    words = ["--dataset", str(dataset), "--holdout", "1", "--methods", "nominal", "--seeds", "0", "--quiet"]
    assert main(["bench", "real", *words, "--heldout-window", "0.5", "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert (row["task"], row["split"], row["error"]) == ("hinge", "1", "")
    assert row["heldout_rmse_nominal"] > 0


def test_recordings_must_be_named(tmp_path: Path) -> None:
    """Without a model the error says what to give."""
    with pytest.raises(ConfigurationError, match="--model"):
        bench(Real(out=tmp_path / "real.json"))


def test_a_file_of_parameters_is_written_by_calibrate(capsys: pytest.CaptureFixture[str]) -> None:
    """A bench only reads one, so it has no option for it."""
    assert main(["bench", "real", "--model", "m.xml", "--write-parameters", "new.yaml"]) == 2
    assert "--write-parameters: `deal-hw bench real` has no such option" in capsys.readouterr().err
