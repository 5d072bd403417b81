"""Actuators of an MJCF in any form: read as what they do, simulated as MuJoCo does, written back."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import SERVO, batch, known, robot, swing

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.mjcf.calibrated import write_calibrated_mjcf
from deal_hw.sim.mjcf.joint_facts import joint_facts
from deal_hw.sim.parameters.drive import drive_of
from deal_hw.sim.parameters.template import template
from deal_hw.sim.parameters.yaml_space import parse_space
from deal_hw.types import FloatArray

PLAIN = SERVO[SERVO.index("<position") : SERVO.index("</actuator>")]
AFFINE = '<general name="shoulder" joint="shoulder" biastype="affine" {}/>'
ELBOW = '<position name="elbow" joint="elbow" kp="10" kv="0.5" forcerange="-3 3"/>'
# The shoulder of SERVO: kp 20, kv 1, 4 N·m.
SAME = {
    "general": 'gainprm="20" biasprm="0 -20 -1" forcerange="-4 4"',
    "gear": 'gear="2" gainprm="5" biasprm="0 -5 -.25" forcerange="-2 2"',
    "mirrored": 'gear="-4" gainprm="1.25" biasprm="0 -1.25 -.0625" forcerange="-1 1"',
    "scaled": 'gainprm="5" biasprm="0 -20 -1" forcerange="-4 4" ctrlrange="-8 8"',
}


def arm(actuator: str, elbow: str = ELBOW) -> str:
    """Return the arm with another shoulder actuator."""
    return SERVO.replace(PLAIN, actuator + elbow)


def free(kind: str, nominal: float) -> Parameter:
    """Return a parameter of the shoulder to search."""
    return Parameter.around(f"shoulder.{kind}", kind, ("shoulder",), "-", nominal)


def ends(members: ServoBatch, theta: list[float], path: FloatArray) -> FloatArray:
    """Return a member's positions under commands, (S, J)."""
    members.set_parameters(np.array([theta]))
    members.set_state(np.array([0.3, -0.1]), np.zeros(2))
    return np.asarray(members.advance(path, every=1)[0][0])


def looped(text: str, ctrl: FloatArray, act: float | list[float] | None = None) -> FloatArray:
    """Return positions in MuJoCo alone under values of ctrl, (S, J)."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.1]
    if act is not None:
        data.act[:] = act
    found = []
    for row in ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return np.array(found)


@pytest.mark.parametrize("form", SAME.values(), ids=SAME)
def test_a_servo_is_the_same_in_every_form(tmp_path: Path, form: str) -> None:
    """Description, parameters in the joint's units, and motion to 1e-12, with other gains and limits too."""
    space = ParameterSpace([free(f"servo_{name}", v) for name, v in
                            (("stiffness", 20.0), ("damping", 1.0), ("effort_limit", 4.0))])  # fmt: skip
    runs = []
    for name, text in (("a", SERVO), ("b", arm(AFFINE.format(form)))):
        (tmp_path / name).mkdir()
        model = robot(tmp_path / name, text)
        assert model.description.stiffness == (20.0, 10.0) and model.description.damping == (1.0, 0.5)
        assert model.description.effort_limit == (4.0, 3.0) and model.description.actuation == "position"
        found = parse_space(
            "parameters: [{kind: servo_stiffness, elements: '*'}, {kind: servo_damping, elements: '*'}, "
            "{kind: servo_effort_limit, elements: '*'}]",
            model.model,
        )
        np.testing.assert_allclose(found.nominal, [20, 10, 1, 0.5, 4, 3])
        members = ServoBatch(model, space, 1, threads=1)
        runs.append([ends(members, t, swing(300, 2)) for t in ([20.0, 1.0, 4.0], [27.0, 0.7, 1.5])])
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-12)
    assert np.abs(runs[0][0] - runs[0][1]).max() > 1e-2


def test_set_points_are_the_joints_whatever_ctrl_is(tmp_path: Path) -> None:
    """Gear -4 and a fourth of the gain: ctrl is the angle times -4 times 4, in MuJoCo alone."""
    text = arm(AFFINE.format('gear="-4" gainprm=".3125" biasprm="0 -1.25 -.0625" forcerange="-1 1"'))
    members = batch(robot(tmp_path, text))
    found = ends(members, members.space.nominal.tolist(), swing(300, 2))
    np.testing.assert_allclose(found, looped(text, swing(300, 2)[0] * [-16.0, 1.0]), atol=1e-12)


@pytest.mark.parametrize("dyntype", ["filter", "filterexact"])
@pytest.mark.parametrize("more", ["", ' actearly="true"', ' gear="2" ctrlrange="-.6 .6"'])
def test_a_filter_acts_as_in_mujoco(tmp_path: Path, dyntype: str, more: str) -> None:
    """The set-point's filter, in rest before the first command, to 1e-12."""
    gear = 2.0 if "gear" in more else 1.0
    text = arm(
        AFFINE.format(f'gainprm="20" biasprm="0 -20 -1" dyntype="{dyntype}" dynprm=".03"{more}'),
        ELBOW.replace("/>", ' timeconst=".05"/>'),
    )
    members = batch(robot(tmp_path, text))
    path = swing(300, 2) + 0.05
    acting, _ = members.commands.act(path, members.commands.memory(path[:, 0]), 0.002)
    found = ends(members, members.space.nominal.tolist(), acting)
    expected = looped(text, path[0] * [gear, 1.0], act=[0.05 * gear, 0.05])
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.abs(looped(text.replace(".03", ".02"), path[0] * [gear, 1.0]) - expected).max() > 1e-3


def test_a_searched_lag_is_that_of_the_filter(tmp_path: Path) -> None:
    """The model's time constant is the nominal value; another one moves as another file does."""
    text = arm(AFFINE.format('gainprm="20" biasprm="0 -20 -1" dyntype="filter" dynprm=".03"'))
    model = robot(tmp_path, text)
    (lag,) = parse_space("parameters: [{kind: command_lag, elements: shoulder}]", model.model)
    assert lag.nominal == 0.03
    assert '# - {kind: command_lag, elements: "shoulder"}  # 0.03 s' in template(model.model)
    assert "command_lag" not in template(mujoco.MjModel.from_xml_string(SERVO))
    members = ServoBatch(model, ParameterSpace([lag]), 1, threads=1)
    members.set_parameters(np.array([[0.07]]))
    path = swing(300, 2)
    acting, _ = members.commands.act(path, members.commands.memory(path[:, 0]), 0.002)
    found = ends(members, [0.07], acting)
    np.testing.assert_allclose(found, looped(text.replace(".03", ".07"), path[0], 0.0), atol=1e-12)


def test_motors_with_damping_and_offset(tmp_path: Path) -> None:
    """A velocity servo, and a motor with back-EMF damping and a constant offset, as MuJoCo moves them."""
    text = arm(
        '<velocity name="shoulder" joint="shoulder" kv="2" gear="3"/>',
        '<general name="elbow" joint="elbow" gear="-2" gainprm="4" biastype="affine" biasprm=".3 0 -.1"/>',
    )
    model = robot(tmp_path, text)
    assert model.description.actuation == "motor" and model.description.effort_limit == (6.0, 8.0)
    facts = joint_facts(tmp_path / "robot.xml")
    assert facts.motor.all() and not facts.servo.any() and facts.gain.tolist() == [6.0, -8.0]
    # A speed of 1 rad/s is 3 at the actuator, 6 of force, 18 N·m.
    np.testing.assert_array_equal(facts.speed_gain, [18.0, np.nan])
    space = parse_space(
        "parameters: [{kind: servo_damping, elements: '*'}, {kind: motor_gain, elements: elbow}]", model.model
    )
    np.testing.assert_allclose(space.nominal, [18.0, 0.4, 8.0])
    members = ServoBatch(model, space, 1, threads=1)
    path = swing(300, 2)
    np.testing.assert_allclose(ends(members, [18.0, 0.4, 8.0], path), looped(text, path[0]), atol=1e-12)
    other = text.replace('kv="2"', 'kv="1"').replace('"4"', '"5"').replace("-.1", "-.2")
    np.testing.assert_allclose(ends(members, [9.0, 0.8, 10.0], path), looped(other, path[0]), atol=1e-12)
    with pytest.raises(ConfigurationError, match=r"velocity servo; its only gain is servo_damping"):
        parse_space("parameters: [{kind: motor_gain, elements: shoulder}]", model.model)


REFUSED = {
    "dyntype='integrator' biastype='affine' gainprm='2' biasprm='0 -2'": r"integrates its command.*<position",
    "<muscle name='odd' joint='shoulder' lengthrange='-1 1'/>": "is a <muscle>",
    "dyntype='user'": "dyntype user",
    "gaintype='affine' gainprm='0 0 -3' ctrlrange='0 1'": "gaintype affine, as <damper>",
    "gaintype='user'": "gaintype user",
    "biastype='user'": "biastype user",
    "biastype='affine' biasprm='0 5'": r"biasprm\[1\] is 5, above 0.*with a minus",
    "biastype='affine' biasprm='0 0 .5'": r"biasprm\[2\] is 0.5",
    "gear='0'": "its gear or gain is 0",
    "dyntype='filter' dynprm='.1' actrange='-1 1'": "actrange.*write ctrlrange",
}


@pytest.mark.parametrize("form", REFUSED)
def test_what_is_not_understood_is_refused_in_one_line(form: str) -> None:
    """By the actuator's name, with what to write."""
    text = form if form.startswith("<") else f'<general name="odd" joint="shoulder" {form}/>'
    model = mujoco.MjModel.from_xml_string(arm(text))
    with pytest.raises(ConfigurationError, match=REFUSED[form]) as caught:
        drive_of(model, 0, "odd")
    assert str(caught.value).startswith("actuator 'odd' ") and "\n" not in str(caught.value)


def test_the_calibrated_file_keeps_general(tmp_path: Path) -> None:
    """Stiffness changes gain and bias, lag the filter's number; a loop with it moves as the calibration."""
    text = arm(
        AFFINE.format('gear="2" gainprm="2.5" biasprm="0 -5 -.25" forcerange="-2 2" dyntype="filter" '
                      'dynprm=".03"'),
        '<position name="elbow" joint="elbow" kp="10" kv=".5" timeconst=".05"/>',
    )  # fmt: skip
    model = robot(tmp_path, text)
    space = ParameterSpace(
        [
            *(free(f"servo_{name}", value) for name, value in (("stiffness", 20.0), ("damping", 1.0))),
            free("servo_effort_limit", 4.0),
            Parameter.around("lag", "command_lag", ("shoulder", "elbow"), "s", 0.04),
            known("servo_play", "elbow", 0.02),
        ]
    )
    theta = np.array([28.0, 1.6, 3.0, 0.06])
    path = tmp_path / "calibrated.xml"
    write_calibrated_mjcf(model, space, theta, path, 0.0)
    written = path.read_text(encoding="utf-8")
    assert '<general name="shoulder"' in written and 'gainprm="3.5" biasprm="0 -7 -0.4"' in written
    assert 'forcerange="-1.5 1.5"' in written and 'dynprm="0.06"' in written and 'timeconst="0.06"' in written
    assert "command_lag" not in written.partition("-->")[2]
    loaded = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(loaded)
    data.qpos[:] = [0.3, -0.1]
    laws = ActuatorLaws(loaded, data)
    commands, found = swing(300, 2), []
    laws.restart(commands[0, 0])
    for command in commands[0]:
        laws.step(command)
        found.append(laws.reported())
    members = ServoBatch(model, space, 1, threads=1)
    members.set_parameters(theta[None])
    acting, _ = members.commands.act(commands, members.commands.memory(commands[:, 0]), 0.002)
    np.testing.assert_allclose(found, ends(members, theta.tolist(), acting), atol=1e-9)
