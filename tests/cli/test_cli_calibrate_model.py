"""``deal-hw calibrate --model``: an MJCF and a CSV file give a report, and bad input an error first."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.cli.main import EXIT_ERROR, EXIT_OK, main
from deal_hw.types import FloatArray

JOINTS = ("shoulder", "elbow")
HIDDEN = {"damping": "0.35", "frictionloss": "0.06"}
ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true" armature="0.01"
             damping="{damping}" frictionloss="{frictionloss}"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3"/>
      <body name="lower" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" range="-2 2" limited="true" armature="0.01" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo_b" joint="elbow" kp="12" kv="0.1" forcerange="-20 20"/>
    <position name="servo_a" joint="shoulder" kp="12" kv="0.1" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
PARAMETERS = """
parameters:
  - {kind: dof_damping, elements: shoulder}
  - {kind: dof_frictionloss, elements: shoulder}
"""
Rows = dict[str, FloatArray]
Change = Callable[[Rows], Rows]


def record(seconds: float, seed: int, shoulder_rad_s: float = np.inf) -> Rows:
    """Play sums of sines on the hidden arm in plain MuJoCo: 50 Hz, commands act 6 ms late, 0.5 mrad noise.

    The shoulder's servo moves its set-point at the given speed at most.
    """
    model = mujoco.MjModel.from_xml_string(ARM.format(**HIDDEN))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.02)
    phases = rng.uniform(0, 2 * np.pi, (len(JOINTS), 3))
    wave = [np.sin(2 * np.pi * np.outer(time, (0.4, 0.9, 1.7)) + p).sum(axis=1) for p in phases]
    target = 0.25 * np.stack(wave, axis=1)
    seen = np.empty_like(target)
    data.qpos[:] = target[0]
    sent = setpoint = target[0]
    for t, wanted in enumerate(target):
        seen[t] = data.qpos
        for step in range(10):
            sent = wanted if step >= 3 else sent
            reach = np.array([shoulder_rad_s, np.inf]) * model.opt.timestep
            setpoint = setpoint + np.clip(sent - setpoint, -reach, reach)
            data.ctrl[:] = setpoint[::-1]  # The actuators come in another order than the joints.
            mujoco.mj_step(model, data)
    seen += 5e-4 * rng.standard_normal(seen.shape)
    rows = {"time": time}
    for j, joint in enumerate(JOINTS):
        rows[f"{joint}_pos"], rows[f"{joint}_cmd"] = seen[:, j], target[:, j]
    return rows


def write(path: Path, rows: Rows) -> Path:
    """Write columns as a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(rows)
        out.writerows(np.stack(list(rows.values()), axis=1).tolist())
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, its parameters and two recordings."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.xml").write_text(ARM.format(damping="0.15", frictionloss="0.03"), encoding="utf-8")
    (folder / "params.yaml").write_text(PARAMETERS, encoding="utf-8")
    write(folder / "rec.csv", record(6.0, 1))
    write(folder / "other.csv", record(3.0, 2))
    return folder


def command(folder: Path, *more: str, data: str = "rec.csv", model: str = "arm.xml") -> list[str]:
    """Return the arguments of a short calibration."""
    words = ["calibrate", "--model", str(folder / model), "--data", str(folder / data)]
    words += ["--parameters", str(folder / "params.yaml"), "--population", "24", "--generations", "16"]
    return [*words, "--threads", "1", *more]


def test_mjcf_and_csv_give_a_report(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Hidden damping and friction are found within 10 %, the latency within 2 ms; held-out error falls."""
    words = command(folder, "--holdout", str(folder / "other.csv"), "--heldout-window", "1")
    assert main([*words, "--out", str(tmp_path)]) == EXIT_OK
    reported = capsys.readouterr()
    assert "held-out RMSE" in reported.out and "guessed" in reported.err
    calibration = tmp_path / "calibration"
    page = (calibration / "report.html").read_text(encoding="utf-8")
    # The window of the held-out error is that of what is drawn; recordings are called by their files.
    assert (
        "restart from the measured state every 1 s" in page and "times better than the nominal model" in page
    )
    assert page.index("<h3>other.csv <span") < page.index("<h3>rec.csv <span")
    found = json.loads((calibration / "result.json").read_text())
    assert found["method"] == "output-error" and "method: output-error" in reported.err
    assert found["parameters"]["shoulder.damping"]["estimate"] == pytest.approx(0.35, rel=0.1)
    assert found["parameters"]["shoulder.frictionloss"]["estimate"] == pytest.approx(0.06, rel=0.1)
    assert found["latency_s"] == pytest.approx(0.006, abs=0.002)
    rmse = found["provenance"]["heldout_rmse"]["mean"]
    assert rmse["calibrated"] < 0.2 * rmse["nominal"] < rmse["null"]
    model = mujoco.MjModel.from_xml_path(str(calibration / "calibrated.xml"))
    assert model.dof_damping[0] == pytest.approx(found["parameters"]["shoulder.damping"]["estimate"])
    assert model.actuator("servo_a").trnid[0] == model.joint("shoulder").id


def test_last_part_is_held_out_and_noise_can_be_said(folder: Path, tmp_path: Path) -> None:
    """Without --holdout the last quarter judges; --residual-std is what residuals are measured by."""
    words = command(folder, "--no-refine", "--no-report", "--quiet", "--residual-std", "0.005")
    assert main([*words, "--generations", "10", "--out", str(tmp_path)]) == EXIT_OK
    found = json.loads((tmp_path / "calibration" / "result.json").read_text())
    assert found["provenance"]["fitted_s"] == pytest.approx(4.48, abs=0.03)
    assert found["provenance"]["heldout_s"] == pytest.approx(1.5, abs=0.03)
    assert found["chi2"] < 0.1  # Ten times the noise that there is.


def test_stretches_are_left_out(folder: Path, tmp_path: Path) -> None:
    """Two of six seconds: 100 of 300 samples are gone, and the recording is in two parts."""
    words = command(folder, "--leave-out", "rec", "2", "4", "--no-refine", "--no-report", "--quiet")
    words += ["--generations", "1", "--holdout-part", "0"]
    assert main([*words, "--out", str(tmp_path)]) == EXIT_OK
    provenance = json.loads((tmp_path / "calibration" / "result.json").read_text())["provenance"]
    assert provenance["fitted_s"] == pytest.approx(3.96, abs=1e-3)
    assert provenance["left_out"] == [["rec", 2.0, 4.0]]


@pytest.mark.slow
def test_speed_limit_of_a_servo_is_found(folder: Path, tmp_path: Path) -> None:
    """The shoulder's set-point moves at 1.2 rad/s at most; that is found within 3 % from 3 rad/s.

    The written model has the limit under <custom>.
    """
    write(folder / "slewed.csv", record(6.0, 1, 1.2))
    more = "  - {kind: servo_speed_limit, elements: servo_a, nominal: 3.0, name: shoulder.speed}\n"
    (folder / "slewed.yaml").write_text(PARAMETERS + more, encoding="utf-8")
    words = command(folder, "--method", "local", "--no-report", "--no-advise", "--quiet", data="slewed.csv")
    words[words.index("--parameters") + 1] = str(folder / "slewed.yaml")
    assert main([*words, "--out", str(tmp_path)]) == EXIT_OK
    found = json.loads((tmp_path / "calibration" / "result.json").read_text())["parameters"]
    assert found["shoulder.speed"]["unit"] == "rad/s"
    assert found["shoulder.speed"]["estimate"] == pytest.approx(1.2, rel=0.03)
    assert found["shoulder.damping"]["estimate"] == pytest.approx(0.35, rel=0.1)
    assert "deal_hw.speed_limit" in (tmp_path / "calibration" / "calibrated.xml").read_text()


@pytest.mark.slow
def test_spikes_do_not_move_the_estimate(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four samples 2 to 4 rad off are named and left out; estimates move by less than their own error."""
    spiked = record(6.0, 1)
    spiked["shoulder_pos"][70] += 3.0
    spiked["shoulder_pos"][[150, 151]] -= 2.5
    spiked["elbow_pos"][200] += 4.0
    write(folder / "spiked.csv", spiked)
    found = {}
    for name in ("rec", "spiked"):
        words = command(
            folder, "--method", "local", "--no-report", "--out", str(tmp_path / name), data=f"{name}.csv"
        )
        assert main([*words, "--holdout", str(folder / "other.csv")]) == EXIT_OK
        found[name] = json.loads((tmp_path / name / "calibration" / "result.json").read_text())
    reported = capsys.readouterr().err
    assert reported.count("warn spikes") == 1 and "spiked.csv: warn spikes: 4 samples" in reported
    assert (
        "shoulder +3 rad at 1.400 s, shoulder -2.49 rad at 3.000 s (2 samples), elbow +4 rad at 4.0"
        in reported
    )
    for parameter, clean in found["rec"]["parameters"].items():
        assert found["spiked"]["parameters"][parameter]["estimate"] == pytest.approx(
            clean["estimate"], abs=0.5 * (clean["high"] - clean["low"])
        )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["local", "default"])
def test_latency_at_the_end_of_its_range(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    """Commands act 6 ms late: with 0 to 4 ms both paths end at 4 ms and say so; 0 to 40 ms is the default."""
    words = command(folder, "--no-report", "--no-advise", "--method", method, "--out", str(tmp_path))
    assert main([*words, "--latency-range", "0", "0.004"]) == EXIT_OK
    found = json.loads((tmp_path / "calibration" / "result.json").read_text())
    assert found["latency_s"] == pytest.approx(0.004)
    assert found["provenance"]["latency_range_s"] == [0.0, 0.004]
    assert any(
        "latency ended at 4 ms" in a["seen"] and "--latency-range 0 0.008" in a["do"] for a in found["alarms"]
    )
    assert "alarm: The latency ended at 4 ms" in capsys.readouterr().out.replace("\n", " ")


def test_parameters_are_written_and_read(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file to edit is written once, names what the model has, and is not overwritten."""
    path = tmp_path / "params.yaml"
    words = ["calibrate", "--model", str(folder / "arm.xml"), "--write-parameters", str(path)]
    assert main(words) == EXIT_OK
    assert "kind: servo_stiffness" in path.read_text() and str(path) in capsys.readouterr().out
    assert main(words) == EXIT_ERROR
    assert "exists" in capsys.readouterr().err


def degrees(rows: Rows) -> Rows:
    """Positions in degrees, commands in radians."""
    return {k: np.rad2deg(v) if k.endswith("_pos") else v for k, v in rows.items()}


def swapped(rows: Rows) -> Rows:
    """The measurements of the two joints under each other's name."""
    other = {"shoulder_pos": "elbow_pos", "elbow_pos": "shoulder_pos"}
    return {k: rows[other.get(k, k)] for k in rows}


def flipped(rows: Rows) -> Rows:
    """One measurement with the wrong sign."""
    return {k: -v if k == "elbow_pos" else v for k, v in rows.items()}


def backwards(rows: Rows) -> Rows:
    """A clock that was set back in the middle."""
    half = len(rows["time"]) // 2
    return {**rows, "time": np.where(np.arange(2 * half) < half, rows["time"], rows["time"] - 2.0)}


def broken(rows: Rows) -> Rows:
    """A tenth of a measurement is not a number."""
    values = rows["elbow_pos"].copy()
    values[::10] = np.nan
    return {**rows, "elbow_pos": values}


def frozen(rows: Rows) -> Rows:
    """A measurement that never changes."""
    return {**rows, "elbow_pos": np.full_like(rows["elbow_pos"], 0.1)}


def short(rows: Rows) -> Rows:
    """A tenth of a second, at 50 Hz."""
    return {k: v[:6] for k, v in rows.items()}


def no_commands(rows: Rows) -> Rows:
    """Positions alone."""
    return {k: v for k, v in rows.items() if not k.endswith("_cmd")}


def one_joint(rows: Rows) -> Rows:
    """The shoulder alone."""
    return {k: v for k, v in rows.items() if not k.startswith("elbow")}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (degrees, "degrees"),
        (swapped, "shoulder"),
        (flipped, "elbow"),
        (backwards, "backwards"),
        (broken, "not finite"),
        (frozen, "without any change"),
        (short, "record at least 0.2 s"),
        (no_commands, "target"),
        (one_joint, "joints of the model without a recorded position: elbow"),
    ],
)
def test_bad_recordings_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Change, message: str
) -> None:
    """One line that says what is wrong, exit status 2, and nothing written."""
    write(folder / "bad.csv", change(record(6.0, 1)))
    assert main(command(folder, "--out", str(tmp_path / "out"), data="bad.csv")) == EXIT_ERROR
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--range", "shoulder.damping", "0.2", "0.9"], "nominal value 0.15 lies outside"),
        (["--free", "shoulder.dmaping"], "shoulder.damping"),
        (["--known", "shoulder.damping", "0.2", "shoulder.frictionloss", "0.1"], "nothing to search"),
        (["--residual-std", "-1"], "allowed are 1e-09 to 1000 rad or m"),
        (["--residual-std", "shoulder", "0.001"], "each of shoulder, elbow"),
        (["--holdout-part", "1.5"], "allowed are 0 to 0.95"),
        (["--physics-step", "0"], "allowed are 0.001 to 100 ms"),
        (["--window", "9"], "no recording holds a window of 9.00 s"),
        (["--heldout-window", "4"], "held-out recordings are too short"),
        (["--leave-out", "nothing.csv", "0", "1"], "no such recording; known are rec.csv"),
        (["--leave-out", "rec.csv", "0", "99"], "--leave-out removes all of rec.csv"),
        (["--space", "k9"], "`calibrate dataset` has it"),
        (["--latency", "12"], "--latency 12.0 s: allowed are 0 to 1 s"),
        (["--latency-range", "0.1", "0.05"], "--latency-range 0.1 0.05: give the lower one first"),
        (["--latency", "0.02", "--latency-range", "0", "0.1"], "--latency gives the latency"),
        (["--spike-ratio", "0.5"], "allowed are 1 to 1000000"),
    ],
)
def test_bad_settings_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    """So are settings that cannot be used."""
    assert main(command(folder, *words, "--out", str(tmp_path / "out"))) == EXIT_ERROR
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_parameter_that_no_rollout_sees_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The arm never reaches its effort limit, so that no recording here tells it."""
    path = tmp_path / "params.yaml"
    entry = "  - {kind: servo_effort_limit, elements: servo_a, range: [15, 60]}\n"
    path.write_text(PARAMETERS + entry, encoding="utf-8")
    assert main(command(folder, "--parameters", str(path), "--out", str(tmp_path / "out"))) == EXIT_ERROR
    assert "depends on servo_a.servo_effort_limit" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody><body/></mujoco>", "does not compile"),
        (ARM.replace('joint="elbow"', 'joint="shoulder"'), "servo_b, servo_a all drive joint 'shoulder'"),
        (
            ARM.replace('<position name="servo_b" joint="elbow" kp="12" kv="0.1" forcerange="-20 20"/>', ""),
            "no actuator of the model drives joint 'elbow'",
        ),
        (
            ARM.replace(
                '<body name="upper">',
                '<body name="upper"><freejoint name="base"/><geom size="0.1"/></body><body>',
            ),
            "floats",
        ),
        (ARM.replace('kp="12" kv="0.1"', 'kp="12" gear="0"', 1), "its gear or gain is 0; write others"),
    ],
)
def test_bad_models_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    """A model that does not compile, or that recordings do not drive."""
    (folder / "bad.xml").write_text(text.replace("{damping}", "0.1").replace("{frictionloss}", "0.1"))
    words = command(folder, "--out", str(tmp_path / "out"), model="bad.xml")
    words = [w for w in words if w not in ("--parameters", str(folder / "params.yaml"))]
    assert main(words) == EXIT_ERROR
    assert message in capsys.readouterr().err


def test_wrong_sign_and_gain_show_under_gravity(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sign that is wrong in command and measurement alike, and a gain far off, are warned of."""
    rows = record(6.0, 1)
    write(folder / "mirror.csv", {k: v if k == "time" else -v for k, v in rows.items()})
    text = (folder / "arm.xml").read_text().replace('kp="12"', 'kp="900"')
    (folder / "stiff.xml").write_text(text)
    params = tmp_path / "params.yaml"
    params.write_text("parameters: [{kind: servo_stiffness, elements: '*'}]\n")
    for data, model, message in (
        ("mirror.csv", "arm.xml", "deviates from its command against gravity"),
        ("rec.csv", "stiff.xml", "sags under gravity as with a gain of about"),
    ):
        words = command(
            folder,
            "--out",
            str(tmp_path / "out"),
            "--generations",
            "2",
            "--no-refine",
            "--no-report",
            "--parameters",
            str(params),
            data=data,
            model=model,
        )
        main(words)
        assert message in capsys.readouterr().err


MOTOR = """
<mujoco model="wheel">
  <option timestep="0.002"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="hub" axis="0 1 0" armature="0.02" damping="0.08" stiffness="2"/>
      <geom type="sphere" size="0.02" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="hub" gear="-2"/></actuator>
</mujoco>
"""


def test_motors_take_torques(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A motor of gear -2 recorded by its torque in N·m: the hidden damping is found within 5 %."""
    (tmp_path / "wheel.xml").write_text(MOTOR)
    hidden = mujoco.MjModel.from_xml_string(MOTOR.replace('damping="0.08"', 'damping="0.2"'))
    data, rng = mujoco.MjData(hidden), np.random.default_rng(3)
    time = np.arange(0.0, 6.0, 0.02)
    torque = np.repeat(rng.uniform(-1.0, 1.0, len(time) // 10), 10)
    seen = np.empty(len(time))
    for t, wanted in enumerate(torque):
        seen[t] = data.qpos[0]
        data.ctrl[0] = wanted / -2.0
        mujoco.mj_step(hidden, data, 10)
    write(
        tmp_path / "rec.csv",
        {"time": time, "hub_pos": seen + 5e-4 * rng.standard_normal(len(time)), "hub_cmd": torque},
    )
    (tmp_path / "params.yaml").write_text("parameters: [{kind: dof_damping, elements: hub}]\n")
    words = command(tmp_path, "--latency", "0", "--quiet", "--no-report", model="wheel.xml")
    # Commands within -1..1 may be a share of 2 N·m, too.
    assert main([*words, "--out", str(tmp_path / "out")]) == EXIT_ERROR
    assert "target_unit: Nm" in capsys.readouterr().err
    (tmp_path / "columns.yaml").write_text(
        "time: time\nposition: '{joint}_pos'\ntarget: '{joint}_cmd'\njoints: [{name: hub, target_unit: Nm}]\n"
    )
    words += ["--columns", str(tmp_path / "columns.yaml")]
    assert main([*words, "--out", str(tmp_path / "out")]) == EXIT_OK
    found = json.loads((tmp_path / "out" / "calibration" / "result.json").read_text())
    assert found["parameters"]["hub.damping"]["estimate"] == pytest.approx(0.2, rel=0.05)
