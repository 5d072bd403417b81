"""Motors that are fed positions, and servos that are fed torques: refused before any search."""

from __future__ import annotations

import csv
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.cli.main import EXIT_ERROR, EXIT_OK, main

MODEL = """
<mujoco model="wheel">
  <option timestep="0.002"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="hub" axis="0 1 0" armature="0.02" damping="0.2" stiffness="0.1"/>
      <geom type="sphere" size="0.02" mass="0.1"/>
    </body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
SERVO = '<position name="drive" joint="hub" kp="8" kv="0.1"{more}/>'
MOTOR = '<motor name="drive" joint="hub" gear="2"{more}/>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both models, and 8 s of each driven as it should be."""
    folder = tmp_path_factory.mktemp("wheel")
    rng = np.random.default_rng(2)
    for name, actuator, size, gear in (("servo", SERVO, 1.0, 1.0), ("motor", MOTOR, 1.5, 2.0)):
        text = MODEL.format(actuator=actuator.format(more=""))
        (folder / f"{name}.xml").write_text(text, encoding="utf-8")
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            out = csv.writer(file)
            out.writerow(["time", "hub_pos", "hub_cmd"])
            for k in range(400):
                if k % 20 == 0:
                    wanted = size * rng.uniform(-1, 1)
                out.writerow([0.02 * k, data.qpos[0] + 5e-4 * rng.standard_normal(), wanted])
                data.ctrl[0] = wanted / gear
                mujoco.mj_step(model, data, 10)
    return folder


@pytest.mark.parametrize(
    ("model", "data", "message"),
    [("motor", "servo", "look like positions (hub)"), ("servo", "motor", "look like efforts (hub)")],
)
def test_the_other_kind_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str, data: str, message: str
) -> None:
    """By `calibrate` and by `data import`, with what to change; --force imports it all the same."""
    files = ["--model", str(folder / f"{model}.xml")]
    words = ["calibrate", *files, "--data", str(folder / f"{data}.csv"), "--generations", "1", "--no-refine"]
    words += ["--out", str(tmp_path / "out")]
    assert main(words) == EXIT_ERROR
    reported = capsys.readouterr().err.splitlines()[-1]
    assert message in reported and "in a copy of the MJCF" in reported
    words = [
        "data",
        "import",
        str(folder / f"{data}.csv"),
        *files,
        "--out",
        str(tmp_path / "set"),
        "--dry-run",
    ]
    assert main(words) == EXIT_ERROR
    assert message in capsys.readouterr().err
    assert main([*words, "--force"]) == EXIT_OK


@pytest.mark.parametrize("kind", ["motor", "servo"])
def test_the_right_kind_is_taken(folder: Path, tmp_path: Path, kind: str) -> None:
    """Each with its own recording passes all checks."""
    files = ["--model", str(folder / f"{kind}.xml")]
    words = [
        "data",
        "import",
        str(folder / f"{kind}.csv"),
        *files,
        "--out",
        str(tmp_path / "set"),
        "--dry-run",
    ]
    assert main(words) == EXIT_OK


def test_commands_that_the_actuator_would_clip_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A ctrlrange of 0.01 at gear 2 takes 0.02 N·m; nearly all commands lie outside."""
    path = tmp_path / "clip.xml"
    path.write_text(MODEL.format(actuator=MOTOR.format(more=' ctrlrange="-0.01 0.01" ctrllimited="true"')))
    words = [
        "calibrate",
        "--model",
        str(path),
        "--data",
        str(folder / "motor.csv"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(words) == EXIT_ERROR
    reported = capsys.readouterr().err
    assert "outside the actuators' ctrlrange" in reported and "takes -0.02..0.02" in reported
