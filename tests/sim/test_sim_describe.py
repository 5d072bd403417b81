"""Descriptions of any MJCF, parts of episodes, and what gravity says of a servo."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.recordings.episode import SENT, SampledEpisode
from deal_hw.sim.recordings.gravity_gain import gravity_gain
from deal_hw.sim.recordings.parts import joined, part, split_last, spread, stretches

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="lift" axis="0 1 0" damping="0.5"/>
      <geom type="sphere" size="0.02" pos="0.1 0 0" mass="1"/>
      <body pos="0 0.1 0">
        <joint name="rail" type="slide" axis="0 1 0" damping="5"/>
        <geom type="sphere" size="0.02" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="second" joint="rail" kp="300" kv="4"/>
    <position name="first" joint="lift" kp="10" kv="0.5" forcerange="-7 7"/>
  </actuator>
</mujoco>
"""


def robot_of(folder: Path, text: str = ARM) -> RobotModel:
    """Return the robot of an MJCF text, recorded at 49.85 Hz."""
    path = folder / "arm.xml"
    path.write_text(text, encoding="utf-8")
    model = compile_mjcf(path)
    rates = sampling(1 / 49.85, float(model.opt.timestep), 0.4)
    return load_model(describe(path, model, ("lift", "rail"), ("lift", "rail"), rates), rates.step_s)


def hold(robot: RobotModel, target: tuple[float, float], position: tuple[float, float]) -> SampledEpisode:
    """Return an episode in which the robot stands at a position under a command."""
    T = 100
    steps = 10 * (T - 1)
    rows = np.ones((steps, 2))
    return SampledEpisode(
        step_s=robot.step_s,
        sample=10 * np.arange(T),
        position=np.tile(position, (T, 1)),
        velocity=np.zeros((T, 2)),
        target=rows * target,
        stiffness=rows * robot.description.stiffness,
        damping=rows * robot.description.damping,
        effort_limit=rows * np.inf,
        speed_limit=rows * np.inf,
        usable=np.ones(T, dtype=bool),
        start_setpoint=np.array(target),
    )


def test_description_holds_what_the_model_says(tmp_path: Path) -> None:
    """Gains, limits and units by joint, although the actuators have other names and another order."""
    robot = robot_of(tmp_path)
    found = robot.description
    assert found.stiffness == (10.0, 300.0) and found.damping == (0.5, 4.0)
    assert found.effort_limit == (7.0, math.inf) and found.actuation == "position"
    assert found.position_units == ("rad", "m") and found.name == "arm"
    assert robot.actuator == (1, 0) and robot.actuator_names == ("first", "second")
    # 20.06 ms hold ten steps near the MJCF's 2 ms.
    assert robot.step_s == pytest.approx(1 / 498.5) and found.state_rate_hz == pytest.approx(49.85)


def test_servo_parameters_act_by_the_actuators_name(tmp_path: Path) -> None:
    """The gain of actuator `first` moves joint `lift` and no other."""
    robot = robot_of(tmp_path)
    space = ParameterSpace([Parameter.around("k", "servo_stiffness", ("first",), "N·m/rad", 10.0)])
    batch = ServoBatch(robot, space, 2, threads=1)
    batch.set_parameters(np.array([[10.0], [40.0]]))
    batch.set_state(np.zeros(2), np.zeros(2))
    x, _ = batch.advance(np.tile([0.2, 0.01], (2, 200, 1)))
    assert abs(x[1, 0, 0] - x[0, 0, 0]) > 0.02
    assert x[1, 0, 1] == pytest.approx(x[0, 0, 1], abs=1e-4)


@pytest.mark.parametrize(
    ("period_s", "timestep_s", "window_s", "steps", "samples"),
    [(0.02, 0.002, 0.4, 10, 1), (0.005, 0.002, 0.4, 2, 4), (0.005, 0.02, 2.0, 1, 20), (0.1, 0.03, 0.1, 3, 1)],
)
def test_physics_grid_fits_into_the_sampling_period(
    period_s: float, timestep_s: float, window_s: float, steps: int, samples: int
) -> None:
    """A whole number of steps near the wanted one; a window's twentieth in whole samples."""
    found = sampling(period_s, timestep_s, window_s)
    assert (found.substeps, found.samples_per_tick) == (steps, samples)
    assert found.step_s == pytest.approx(period_s / steps)


def test_motors_are_known_alone_and_beside_servos(tmp_path: Path) -> None:
    """Motors take efforts: the limit is the torque at a control of 1; a servo keeps its own."""
    servo = '<position name="first" joint="lift" kp="10" kv="0.5" forcerange="-7 7"/>'
    motor = '<motor name="first" joint="lift" gear="30"/>'
    mixed = robot_of(tmp_path, ARM.replace(servo, motor)).description
    assert (mixed.actuation, mixed.motors, mixed.servos) == ("position", ("lift",), (False, True))
    assert (mixed.stiffness, mixed.damping, mixed.effort_limit[0]) == ((0.0, 300.0), (0.0, 4.0), 30.0)
    other = '<position name="second" joint="rail" kp="300" kv="4"/>'
    text = ARM.replace(servo, motor).replace(other, '<motor name="second" joint="rail" gear="-2"/>')
    found = robot_of(tmp_path, text).description
    assert found.actuation == "motor" and found.effort_limit == (30.0, 2.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('kp="300" kv="4"', 'kp="300" dyntype="integrator"'), None),
        (('<position name="first"', '<velocity name="first" kv="2"/><position name="first"'), None),
        (('kp="10" kv="0.5"', 'kp="10" gear="0"'), "'first' moves nothing, its gear or gain is 0"),
        (('<joint name="rail"', '<joint name="extra" axis="1 0 0"/><joint name="rail"'), "extra"),
    ],
)
def test_what_recordings_do_not_drive_is_refused(
    tmp_path: Path, change: tuple[str, str], message: str | None
) -> None:
    """Each with its name."""
    with pytest.raises(ConfigurationError, match=message):
        robot_of(tmp_path, ARM.replace(*change))


def test_unknown_joint_lists_the_joints(tmp_path: Path) -> None:
    """A joint that the model lacks."""
    path = tmp_path / "arm.xml"
    path.write_text(ARM, encoding="utf-8")
    with pytest.raises(UnknownNameError, match="lift, rail"):
        describe(path, compile_mjcf(path), ("lift", "knee"), ("lift",), sampling(0.02, 0.002, 0.4))


def test_parts_keep_samples_and_commands_together(tmp_path: Path) -> None:
    """A command step at period 500 is 100 periods before sample 60, in the part as in the whole."""
    whole = hold(robot_of(tmp_path), (0.0, 0.0), (0.1, 0.0))
    target = whole.target.copy()
    target[500:] = 1.0
    whole = dataclasses.replace(whole, target=target, position=np.arange(100.0)[:, None] * [1.0, 1.0])
    cut = part(whole, 55, 80)
    assert cut.position[0, 0] == 55.0 and len(cut.sample) == 25
    assert np.all(np.diff(cut.sample) == 10) and cut.steps == cut.sample[-1]
    assert int(np.argmax(cut.target[:, 0] == 1.0)) == cut.sample[5] - 100
    assert cut.start_setpoint[0] == 0.0 and cut.first_row == 55
    first, last = split_last(whole, 0.25)
    assert first.position[-1, 0] == last.position[0, 0] == 74.0
    parts = stretches(whole, 0.5)
    assert sum(len(p.sample) - 1 for p in parts) == 99 and len(parts) == 4
    assert [p.first_row for p in spread(parts, 1.0)] == [parts[1].first_row, parts[3].first_row]
    assert spread(parts, 9.0) == parts
    (again,) = joined(parts)
    for name in ("sample", "position", "usable", *SENT):
        assert np.array_equal(getattr(again, name), getattr(whole, name))
    middle = joined([parts[1], parts[2], parts[0]])
    assert [(e.first_row, len(e.sample)) for e in middle] == [
        (parts[1].first_row, len(parts[1].sample) + len(parts[2].sample) - 1),
        (0, len(parts[0].sample)),
    ]


def test_gravity_tells_a_gain_and_its_sign(tmp_path: Path) -> None:
    """1 kg at 0.1 m weighs 0.981 N·m at the joint (the slide lies on its axis): 0.1 rad is 9.8 N·m/rad."""
    robot = robot_of(tmp_path)
    # The arm points along x at 0 rad; gravity turns it towards positive angles about +y.
    found = gravity_gain(robot, [hold(robot, (-0.1, 0.0), (0.0, 0.0))])
    assert found is not None
    assert found.gain[0] == pytest.approx(9.81, rel=1e-6) and found.explained[0] == pytest.approx(1.0)
    assert found.load[0] == pytest.approx(0.981) and found.deviation[0] == pytest.approx(0.1)
    assert found.load[1] == pytest.approx(0.0, abs=1e-9)
    mirrored = gravity_gain(robot, [hold(robot, (0.1, 0.0), (0.0, 0.0))])
    assert mirrored is not None and mirrored.gain[0] < 0
    # An actuator that carries .5 N·m by itself needs .481 N·m of the servo.
    text = ARM.replace(
        '<position name="first" joint="lift" kp="10" kv="0.5"',
        '<general name="first" joint="lift" gainprm="10" biastype="affine" biasprm="-.5 -10 -.5"',
    )
    helped = gravity_gain(robot_of(tmp_path, text), [hold(robot, (-0.0481, 0.0), (0.0, 0.0))])
    assert helped is not None and helped.gain[0] == pytest.approx(10.0, rel=1e-6)


def test_an_actuator_that_drives_no_joint_is_named_as_such(tmp_path: Path) -> None:
    """The message about a tendon's motor asked for a target, which it had."""
    path = tmp_path / "arm.xml"
    tendon = '<tendon><fixed name="belt"><joint joint="lift" coef="1"/></fixed></tendon>'
    motor = '<motor name="winch" tendon="belt"/></actuator>'
    path.write_text(ARM.replace("</actuator>", motor).replace("</mujoco>", tendon + "</mujoco>"))
    model = compile_mjcf(path)
    with pytest.raises(ConfigurationError, match=r"that drive no joint: winch \(a tendon\)"):
        describe(path, model, ("lift", "rail"), ("lift", "rail"), sampling(0.02, 0.002, 0.4))
