"""Servos beside motors or velocity servos: each drive takes its own kind of command."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.errors import DatasetError
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.mjcf.exports import actuator_tables
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.sim.robots.user_robot import read_robot
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings
from deal_hw.workflows.import_export import ImportSettings, import_recordings

ARM = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper">
    <joint name="hip" axis="0 1 0" armature="0.02" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3" contype="0" conaffinity="0"/>
    <body name="lower" pos="0 0 -.2">
      <joint name="knee" axis="0 1 0" armature="0.01" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2" contype="0" conaffinity="0"/>
    </body>
  </body></worldbody>
  <actuator><position name="hip" joint="hip" kp="30" kv="{kv}"/>{second}</actuator>
</mujoco>"""
SECOND = {
    "motor": '<motor name="knee" joint="knee" gear="{gain}" ctrlrange="-1 1"/>',
    "speed": '<velocity name="knee" joint="knee" kv="{gain}"/>',
}
OWN, TRUE = {"kv": 1.0, "gain": 2.0}, {"kv": 1.6, "gain": 2.6}


def text(kind: str, kv: float, gain: float) -> str:
    """Return the MJCF of an arm whose knee takes efforts or speeds."""
    return ARM.format(kv=kv, second=SECOND[kind].format(gain=gain))


def robot(folder: Path, kind: str) -> RobotModel:
    """Return the robot of the owner's model."""
    path = folder / "arm.xml"
    path.write_text(text(kind, **OWN))
    names = ["hip", "knee"]
    return load_model(describe(path, compile_mjcf(path), names, names, sampling(0.01, 0.002, 0.2)))


def play(model: mujoco.MjModel, control: FloatArray, every: int = 1) -> FloatArray:
    """Return positions before each command, (T, 2), of commands that are held for some steps."""
    data, seen = mujoco.MjData(model), []
    for now in control:
        seen.append(data.qpos.copy())
        data.ctrl[:] = now
        mujoco.mj_step(model, data, every)
    return np.array(seen)


def record(kind: str, seed: int) -> dict[str, FloatArray]:
    """Return 100 Hz of the real arm: set-points and, as recorded, efforts by the owner's gear or speeds."""
    rng = np.random.default_rng(seed)
    # Efforts above 1 N·m cannot be a share of full power.
    control = np.repeat(rng.uniform(-1, 1, (20, 2)) * [0.5, 0.9], 20, axis=0)
    control[:20] = 0.0
    seen = play(mujoco.MjModel.from_xml_string(text(kind, **TRUE)), control, 5)
    seen += 5e-4 * rng.standard_normal(seen.shape)
    unit = OWN["gain"] if kind == "motor" else 1.0
    time: FloatArray = 0.01 * np.arange(len(seen), dtype=np.float64)
    return {
        "time": time,
        "hip_pos": seen[:, 0],
        "knee_pos": seen[:, 1],
        "hip_cmd": control[:, 0],
        "knee_cmd": unit * control[:, 1],
    }


@pytest.mark.parametrize("kind", SECOND)
def test_the_simulation_is_mujocos(kind: str, tmp_path: Path) -> None:
    """With gains sent by the host, and an encoder's bias, which only the servo feels in its set-point."""
    one = robot(tmp_path, kind)
    assert one.description.servos == (True, False)
    assert one.description.motors == ("knee",)
    assert one.description.held(np.array([0.2, 0.3])).tolist() == [0.2, 0.0]
    space, bias = default_space(one.model), np.array([0.01, -0.02])
    values = dict(zip(space.names, space.nominal, strict=True))
    values |= {"hip.encoder_bias": bias[0], "knee.encoder_bias": bias[1]}
    batch = ServoBatch(one, space, 1, threads=1)
    batch.set_parameters(np.array([list(values.values())]))
    batch.set_sent(np.array([15.0, 0.0]), np.array([0.5, 0.0]), np.array([np.inf, 1.0]))
    batch.set_state(bias, np.zeros(2))
    control = np.repeat(np.random.default_rng(0).uniform(-0.5, 0.5, (10, 2)), 20, axis=0)
    found = batch.advance(control[None], every=1)[0][0] - bias
    plain = mujoco.MjModel.from_xml_string(text(kind, kv=0.5, gain=OWN["gain"]).replace('kp="30"', 'kp="15"'))
    expected = play(plain, np.concatenate([control - [bias[0], 0.0], np.zeros((1, 2))]))
    assert found == pytest.approx(expected[1:], abs=1e-9)


@pytest.mark.parametrize("kind", SECOND)
def test_both_drives_are_found(kind: str, tmp_path: Path) -> None:
    """The servo's damping and the other drive's gain within 5 %; exports have each as what it is."""
    path = robot(tmp_path, kind).description.mjcf
    gain = "knee.motor_gain" if kind == "motor" else "knee.servo_damping"
    searched = {"hip.servo_damping", gain}
    space = calibration_input(FilesSettings(path, record(kind, 0))).space
    assert searched <= set(space.names)
    known = {p.name: p.nominal for p in space if p.name not in searched}
    work = deal_hw.calibrate(path, record(kind, 0), holdout=record(kind, 1), known=known, threads=1)
    found = dict(zip(work.result.space.names, work.result.estimate, strict=True))
    assert found["hip.servo_damping"] == pytest.approx(TRUE["kv"], rel=0.05)
    assert found[gain] == pytest.approx(TRUE["gain"], rel=0.05)
    table = actuator_tables(work.inputs.robot, work.result)["isaac_lab"]
    assert table["stiffness"].get("hip") == pytest.approx(30.0)
    assert table["stiffness"].get("knee") == (None if kind == "motor" else 0.0)


@pytest.mark.parametrize("kind", SECOND)
def test_a_dataset_keeps_both(kind: str, tmp_path: Path) -> None:
    """robot.yaml has the motor as a joint without stiffness, commanded by -1 to 1."""
    path, rows = robot(tmp_path, kind).description.mjcf, record(kind, 0)
    file = tmp_path / "rec.csv"
    np.savetxt(file, np.stack(list(rows.values()), 1), delimiter=",", header=",".join(rows), comments="")
    import_recordings(ImportSettings(paths=(file,), model=path, out=tmp_path / "set"))
    own = read_robot(tmp_path / "set" / "robot" / "robot.yaml")
    one = load_model(own.description())
    assert one.description.motors == ("knee",)
    assert one.description.limits.target[1] == (-1.0, 1.0)


def test_each_command_is_checked_as_what_it_is(tmp_path: Path) -> None:
    """Positions in the motor's column are named, though the other joint is a servo."""
    path, rows = robot(tmp_path, "motor").description.mjcf, record("motor", 0)
    wrong = rows | {"knee_cmd": rows["knee_pos"]}
    with pytest.raises(DatasetError, match="positions for a motor"):
        calibration_input(FilesSettings(path, wrong))
