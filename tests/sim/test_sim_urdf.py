"""A URDF holds no drives: commands are refused with what writes them, from its limits and a PD."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.sim.mjcf.urdf import is_urdf
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.robots.holding import hold
from deal_hw.sim.robots.user_robot import read_robot
from deal_hw.types import FloatArray
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings
from deal_hw.workflows.import_export import ImportSettings, import_recordings
from deal_hw.workflows.own_robot.new import new_robot

LINK = (
    '<link name="{name}"><inertial><origin xyz="0 0 -.1"/><mass value="{mass}"/>'
    '<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="1e-4"/></inertial>{more}</link>'
)
MESH = '<visual><geometry><mesh filename="meshes/upper.obj"/></geometry></visual>'
URDF = (
    '<robot name="arm"><mujoco><compiler strippath="false" discardvisual="false"/></mujoco>'
    '<link name="world"/>'
    + LINK.format(name="upper", mass=1, inertia=0.01, more=MESH)
    + LINK.format(name="lower", mass=0.5, inertia=0.005, more="")
    + '<joint name="hip" type="revolute"><parent link="world"/><child link="upper"/><axis xyz="0 1 0"/>'
    '<limit lower="-2" upper="2" effort="5" velocity="9"/><dynamics damping="0.3" friction="0.1"/></joint>'
    '<joint name="knee" type="continuous"><parent link="upper"/><child link="lower"/>'
    '<origin xyz="0 0 -.3"/><axis xyz="0 1 0"/><dynamics damping="0.2"/></joint></robot>'
)
CORNERS = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """An arm with a mesh in a folder beside it."""
    (tmp_path / "arm" / "meshes").mkdir(parents=True)
    (tmp_path / "arm" / "meshes" / "upper.obj").write_text(CORNERS)
    path = tmp_path / "arm" / "arm.urdf"
    path.write_text(URDF)
    return path


def rows(commands: bool) -> dict[str, FloatArray]:
    """Return 4 s of two joints, with commands that they follow or without any."""
    time, rng = 0.01 * np.arange(400), np.random.default_rng(0)
    target = {"hip": 0.4 * np.sin(4 * time), "knee": 0.3 * np.sin(6 * time)}
    found: dict[str, FloatArray] = {"time": np.asarray(time, dtype=np.float64)}
    for name, values in target.items():
        found[f"{name}_pos"] = 0.97 * np.roll(values, 3) + 5e-4 * rng.standard_normal(400)
        found |= {f"{name}_cmd": values} if commands else {}
    return found


def test_commands_of_a_urdf_are_refused_with_what_writes_drives(urdf: Path, tmp_path: Path) -> None:
    """In calibrate and in import alike; a recording without commands needs no drives."""
    assert is_urdf(urdf)
    file, found = tmp_path / "r.csv", rows(True)
    np.savetxt(file, np.stack(list(found.values()), 1), delimiter=",", header=",".join(found), comments="")
    said = r"arm\.urdf is a URDF, which holds no drives.*hip, knee.*deal-hw robot new .*arm\.urdf.*arm\.xml"
    with pytest.raises(ConfigurationError, match=said):
        calibration_input(FilesSettings(urdf, found))
    with pytest.raises(ConfigurationError, match=said):
        import_recordings(ImportSettings(paths=(file,), model=urdf, out=tmp_path / "set"))
    assert calibration_input(FilesSettings(urdf, rows(False))).robot.description.actuated == ()


def test_robot_new_writes_servos_that_hold(urdf: Path, tmp_path: Path) -> None:
    """Kp is 5 N·m at 0.2 rad, or 5 Hz of the joint's inertia; both are critically damped, with the limit."""
    out = tmp_path / "own" / "robot.yaml"
    new_robot(urdf, control_rate=50.0, out=out)
    robot = read_robot(out)
    assert robot.mjcf == tmp_path / "own" / "arm.xml"
    assert "which holds no drives" in robot.mjcf.read_text()
    assert mujoco.MjModel.from_xml_path(str(robot.mjcf)).nmesh == 1
    hip, knee = (drive_of(robot.model, i, "") for i in range(2))
    inertia = robot.model.dof_M0
    assert hip.stiffness == pytest.approx(25)
    assert hip.effort_limit == pytest.approx(5)
    assert knee.stiffness == pytest.approx(inertia[1] * (10 * np.pi) ** 2, rel=1e-4)
    assert hip.damping == pytest.approx(2 * np.sqrt(hip.stiffness * inertia[0]), rel=1e-4)
    held = hold(robot)
    assert not held.diverged and not held.unstable
    assert np.all(np.abs(held.sag) < 0.01)
    found = calibration_input(FilesSettings(robot.mjcf, rows(True)))
    assert found.robot.description.actuated == ("hip", "knee")
    out.unlink()
    with pytest.raises(ConfigurationError, match=r"arm\.xml exists"):
        new_robot(urdf, control_rate=50.0, out=out)
