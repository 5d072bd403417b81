"""Limits and dampings that an MJCF has outside a joint's actuator: one drive, and the file keeps its form."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.calibrated import write_calibrated_mjcf
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.mjcf.joint_facts import joint_facts
from deal_hw.sim.parameters import check_space
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.parameters.one_drive import gather, scatter
from deal_hw.types import FloatArray

ARM = """<mujoco>
  <option timestep="0.002"/>
  <worldbody><body>
    <joint name="hub" axis="0 1 0" damping="0.1" armature="0.01" {joint}/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/>
  </body></worldbody>
  <actuator>{actuators}</actuator>
</mujoco>"""
SERVO = '<position name="p" joint="hub" kp="40" kv="1"/>'
PAIR = '<position name="p" joint="hub" kp="40"/><velocity name="v" joint="hub" kv="3"/>'
LIMIT = 'actuatorfrcrange="-3 3"'
CASES = {
    "limit": ARM.format(joint=LIMIT, actuators=SERVO),
    "gear": ARM.format(joint='actuatorfrcrange="-3 5"', actuators=SERVO.replace("kp", 'gear="-2" kp')),
    "both": ARM.format(joint=LIMIT, actuators=SERVO.replace("kp", 'forcerange="-4 4" kp')),
    "smaller": ARM.format(joint=LIMIT, actuators=SERVO.replace("kp", 'forcerange="-2 2" kp')),
    "pair": ARM.format(joint="", actuators=PAIR),
    "pair, geared": ARM.format(
        joint=LIMIT, actuators=PAIR.replace("kp", 'gear="2" kp').replace("kv", 'gear="3" kv')
    ),
    "three": ARM.format(joint="", actuators=PAIR.replace('kp="40"', 'kp="40" kv="0.5"')),
    "motor": ARM.format(joint=LIMIT, actuators='<motor name="m" joint="hub" gear="40"/>'),
}


def motion(model: mujoco.MjModel) -> FloatArray:
    """Return angles of a motion that reaches the limits; velocity servos beside others get 0."""
    data, seen = mujoco.MjData(model), []
    for k in range(400):
        data.ctrl[0] = 0.8 * np.sign(np.sin(0.05 * k))
        mujoco.mj_step(model, data)
        seen.append(data.qpos[0])
    return np.array(seen)


@pytest.mark.parametrize("text", CASES.values(), ids=CASES.keys())
def test_the_motion_stays_and_the_file_comes_back(text: str) -> None:
    """A gathered model moves as the file does, to 1e-9 rad; unchanged, all of the file's numbers return."""
    file = mujoco.MjModel.from_xml_string(text)
    model = copy.copy(file)
    gather(model)
    assert motion(model) == pytest.approx(motion(file), abs=1e-9)
    assert not model.jnt_actfrclimited.any()
    again = copy.copy(model)
    gather(again)
    scatter(again, file)
    for name in ("gainprm", "biasprm", "forcerange", "forcelimited"):
        assert np.array_equal(getattr(again, f"actuator_{name}"), getattr(file, f"actuator_{name}")), name
    assert np.array_equal(again.jnt_actfrcrange, file.jnt_actfrcrange)
    assert np.array_equal(again.jnt_actfrclimited, file.jnt_actfrclimited)


def robot(folder: Path, text: str) -> RobotModel:
    """Return a robot with the model of a case."""
    path = folder / "arm.xml"
    path.write_text(text)
    return load_model(describe(path, compile_mjcf(path), ["hub"], ["hub"], sampling(0.01, 0.002, 0.2)))


@pytest.mark.parametrize(
    ("case", "limit", "damping"),
    [
        ("limit", 3.0, 1.0),
        ("both", 3.0, 1.0),
        ("smaller", 2.0, 1.0),
        ("pair", np.inf, 3.0),
        ("pair, geared", 3.0, 27.0),
        ("three", np.inf, 3.5),
    ],
)
def test_the_drive_has_all_of_it(case: str, limit: float, damping: float, tmp_path: Path) -> None:
    """One servo a joint, with the limit of the joint and the damping of both actuators, at the joint."""
    one = robot(tmp_path, CASES[case])
    drive = drive_of(one.model, one.actuator[0], "p")
    assert drive.takes == "position"
    assert drive.effort_limit == pytest.approx(limit)
    assert drive.damping == pytest.approx(damping)
    assert list(one.description.effort_limit) == pytest.approx([limit])
    facts = joint_facts(one.description.mjcf)
    assert facts.servo.all() and not facts.motor.any()


@pytest.mark.parametrize("case", ["limit", "gear", "both", "smaller", "pair", "pair, geared", "three"])
def test_calibrated_values_are_written_where_the_file_has_them(case: str, tmp_path: Path) -> None:
    """MuJoCo alone moves the written file as the calibrated model; its text keeps its form."""
    one = robot(tmp_path, CASES[case])
    space = default_space(one.model, ["p"])
    values = dict(zip(space.names, space.nominal * 1.3, strict=True))
    assert "p.servo_damping" in values
    assert ("p.servo_effort_limit" in values) == (case not in ("gear", "pair", "three"))
    path = tmp_path / "out" / "calibrated.xml"
    path.parent.mkdir()
    write_calibrated_mjcf(one, space, np.array(list(values.values())), path, 0.0)
    text, model = path.read_text(), mujoco.MjModel.from_xml_path(str(path))
    assert ("<velocity" in text) == ("pair" in case or case == "three")
    assert ("actuatorfrcrange" in text) == ("actuatorfrcrange" in CASES[case])
    assert ("forcerange" in text.replace("actuatorfrcrange", "")) == ("forcerange" in CASES[case])
    found = drive_of(compile_mjcf(path), 0, "p")
    assert found.damping == pytest.approx(values["p.servo_damping"])
    assert found.stiffness == pytest.approx(values["p.servo_stiffness"])
    limit = values.get("p.servo_effort_limit")
    if limit is not None:
        data = mujoco.MjData(model)
        data.ctrl[0] = 100.0
        mujoco.mj_forward(model, data)
        assert data.qfrc_actuator[0] == pytest.approx(limit)


def test_what_is_no_single_drive(tmp_path: Path) -> None:
    """Two motors are refused; the damping of a pair is searched at its position servo."""
    two = ARM.format(joint="", actuators=PAIR.replace("velocity", "motor").replace('kv="3"', ""))
    with pytest.raises(ConfigurationError, match="all drive joint 'hub'"):
        robot(tmp_path, two)
    limited = ARM.format(joint="", actuators=PAIR.replace("kv", 'forcerange="-1 1" kv'))
    with pytest.raises(ConfigurationError, match="actuatorfrcrange"):
        robot(tmp_path, limited)
    pair = robot(tmp_path, CASES["pair"])
    space = default_space(pair.model)
    assert not any("v" in p.elements for p in space.parameters)
    p = space["p.servo_damping"]
    with pytest.raises(ConfigurationError, match="beside it"):
        check_space(pair.model, ParameterSpace([dataclasses.replace(p, elements=("v",))]))
