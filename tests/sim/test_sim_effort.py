"""Effort sensors: what a robot reports of its motors' torques, with gain, bias and delay."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.sine_arm import JOINTS, MJCF

from deal_hw.errors import ConfigurationError
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.parameters.yaml_space import parse_space

ALL = """parameters:
  - {kind: effort_gain, elements: elbow}
  - {kind: effort_bias, elements: elbow}
  - {kind: effort_delay, elements: [elbow, yaw], group: together, name: delay}
"""
STEP_S = 0.002


@pytest.fixture
def robot(tmp_path: Path) -> RobotModel:
    path = tmp_path / "arm.xml"
    path.write_text(MJCF, encoding="utf-8")
    model = mujoco.MjModel.from_xml_path(str(path))
    return load_model(describe(path, model, JOINTS, JOINTS, sampling(0.01, STEP_S, 0.4)), STEP_S)


def _torques(steps: int) -> np.ndarray:
    """Return the torque of the last step before each sample, each fifth step, (S, 3): by MuJoCo alone."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    data, found = mujoco.MjData(model), []
    data.ctrl[:] = 0.3, -0.2, 0.4
    for _ in range(steps):
        mujoco.mj_step(model, data)
        found.append(np.array(data.qfrc_actuator))
    return np.array(found)


def test_reports_are_gain_times_older_torque_plus_bias(robot: RobotModel) -> None:
    """One member reports the torque itself, one 1.2 times that of two steps and a half earlier, plus 0.3."""
    space = parse_space(ALL, robot.model)
    batch = ServoBatch(robot, space, 2, threads=1)
    batch.set_parameters(np.array([[1.0, 0.0, 0.0], [1.2, 0.3, 2.5 * STEP_S]]))
    batch.set_state(np.zeros(3), np.zeros(3))
    setpoint = np.broadcast_to([0.3, -0.2, 0.4], (2, 20, 3))
    batch.advance(setpoint, every=5)
    torque, last = _torques(20), np.arange(4, 20, 5)
    assert batch.effort_joints == (0, 2) and batch.effort.shape == (2, 4, 2)
    np.testing.assert_allclose(batch.effort[0], torque[last][:, [0, 2]], rtol=1e-12)
    older = (torque[last - 2] + torque[last - 3]) / 2
    np.testing.assert_allclose(batch.effort[1, :, 1], 1.2 * older[:, 2] + 0.3, rtol=1e-9)
    np.testing.assert_allclose(batch.effort[1, :, 0], older[:, 0], rtol=1e-9)


def test_a_member_that_diverged_reports_nothing(robot: RobotModel) -> None:
    """Its effort is NaN, as its positions are."""
    batch = ServoBatch(robot, parse_space(ALL, robot.model), 2, threads=1)
    batch.set_state(np.zeros((2, 3)), np.array([[0.0] * 3, [1e9] * 3]))
    position, _ = batch.advance(np.zeros((2, 5, 3)), every=5)
    assert np.isnan(position[1]).all() and np.isnan(batch.effort[1]).all()
    assert np.isfinite(batch.effort[0]).all()


def test_without_an_effort_parameter_nothing_is_recorded(robot: RobotModel) -> None:
    """Torques cost memory in every rollout."""
    space = parse_space("parameters: [{kind: dof_damping, elements: yaw}]", robot.model)
    batch = ServoBatch(robot, space, 1, threads=1)
    assert batch.recorded == ("qpos", "qvel") and batch.effort_joints == ()


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("kind: effort_noise, elements: elbow, nominal: 0.1", "no search can find it"),
        ("kind: effort_gain, elements: passive", "no actuator drives joint 'passive'"),
    ],
)
def test_wrong_entries_say_what_to_write(entry: str, words: str) -> None:
    """Noise is known or estimated; a joint without a motor has no effort."""
    text = MJCF.replace(
        '<body name="lower" pos="0 0 0.25">',
        '<body name="tip" pos="0 0 0.5"><joint name="passive"/><geom size="0.01"/></body>'
        '<body name="lower" pos="0 0 0.25">',
    )
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(ConfigurationError) as caught:
        parse_space(f"parameters:\n  - {{{entry}}}", model)
    assert words in str(caught.value)
