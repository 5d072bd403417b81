"""A calibrated MJCF in a loop of mj_step of one's own, with its laws, moves as the calibration does."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import MOTOR, SERVO, batch, known, moved, robot, swing

from deal_hw.errors import ConfigurationError
from deal_hw.sim.actuators import ActuatorLaws
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.laws.setpoints import delay, slew
from deal_hw.sim.mjcf.calibrated import write_calibrated_mjcf

LATENCY_S = 0.007


def calibrated(tmp_path: Path, members: ServoBatch) -> mujoco.MjModel:
    """Return the calibrated MJCF of a batch's only member, compiled."""
    path = tmp_path / "calibrated.xml"
    write_calibrated_mjcf(members.robot, members.space, members.space.nominal, path, LATENCY_S)
    return mujoco.MjModel.from_xml_path(str(path))


@pytest.mark.parametrize(
    "kinds",
    [
        {"dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3, "command_lag": 0.02},
        {"dof_friction_load": 0.1, "servo_play": 0.03, "motor_free_speed": 2.5},
        {"servo_dead_zone": 0.02, "servo_punch": 0.1, "dof_friction_load": 0.1, "encoder_scale": 1.1},
        {
            "transmission_stiffness": 60.0,
            "transmission_damping": 0.1,
            "transmission_play": 0.01,
            "dof_friction_load": 0.1,
            "encoder_scale": 1.1,
            "motor_free_speed": 2.5,
        },
        {
            "transmission_stiffness": 60.0,
            "transmission_play": 0.01,
            "encoder_at_motor": 1.0,
            "servo_dead_zone": 0.02,
            "dof_friction_load": 0.1,
            "encoder_scale": 1.1,
            "encoder_bias": 0.05,
        },
        {
            "transmission_stiffness": 60.0,
            "servo_dead_zone": 0.02,
            "servo_punch": 0.1,
            "dof_friction_load": 0.1,
        },
        {"transmission_stiffness": 60.0, "transmission_play": 0.01, "friction_at_motor": 1.0},
        {"servo_resolution": 0.01, "servo_speed_limit": 1.0, "encoder_bias": 0.05},
        {"servo_speed_limit": 1.0, "command_delay": 0.005, "encoder_scale": 1.1, "encoder_bias": 0.05},
    ],
    ids="+".join,
)
def test_a_loop_with_the_laws_moves_as_the_calibration(tmp_path: Path, kinds: dict[str, float]) -> None:
    """Servos: the shoulder has laws, the elbow none."""
    members = batch(robot(tmp_path, SERVO), *(known(kind, "shoulder", v) for kind, v in kinds.items()))
    path = swing(400, 2)
    model = calibrated(tmp_path, members)
    start = np.array([0.1, -0.1])
    found = moved(model, path[0], start)

    rate = np.array([[kinds.get("servo_speed_limit", np.inf), np.inf]]) * 0.002
    ahead = slew(path[:, 0], path, rate)
    late = delay(ahead, members.lag_s(np.array([LATENCY_S])) / 0.002, path[:, 0])
    acting, _ = members.commands.act(late, members.commands.memory(path[:, 0]), 0.002)
    scale = np.array([kinds.get("encoder_scale", 1.0), 1.0])
    members.set_state(scale * start + [kinds.get("encoder_bias", 0.0), 0.0], np.zeros(2))
    expected, _ = members.advance(acting, every=1)
    np.testing.assert_allclose(found, expected[0], atol=1e-9)
    assert np.abs(np.diff(found, axis=0)).max() > 1e-4


def test_motors_have_their_laws_too(tmp_path: Path) -> None:
    """Dead zone, asymmetry and saturation of a wheel's commands, and a spring behind its motor."""
    laws = {"command_dead_zone": 0.1, "command_asymmetry": 0.2, "command_saturation": 0.4}
    laws |= {"transmission_stiffness": 30.0, "transmission_play": 0.02}
    members = batch(robot(tmp_path, MOTOR), *(known(kind, "wheel", v) for kind, v in laws.items()))
    path = swing(300, 1)
    found = moved(calibrated(tmp_path, members), path[0], np.zeros(1))
    late = delay(path, np.full(1, LATENCY_S / 0.002), path[:, 0])
    acting, _ = members.commands.act(late, members.commands.memory(path[:, 0]), 0.002)
    members.set_state(np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(found, members.advance(acting, every=1)[0][0], atol=1e-9)


def test_a_model_without_laws_moves_as_mujoco_alone() -> None:
    """Nothing in <custom>: the step is mj_step's, to the last bit."""
    one, two = (mujoco.MjModel.from_xml_string(SERVO) for _ in range(2))
    found = moved(one, swing(200, 2)[0], np.zeros(2))
    data = mujoco.MjData(two)
    expected = []
    for command in swing(200, 2)[0]:
        data.ctrl[:] = command
        mujoco.mj_step(two, data)
        expected.append(data.qpos.copy())
    np.testing.assert_array_equal(found, np.array(expected))


def test_values_without_their_elements_are_refused() -> None:
    """Two values for one joint: the message says what to do."""
    custom = (
        '<custom><numeric name="deal_hw.dof_friction_load" data="0.1 0.2"/>'
        '<text name="deal_hw.dof_friction_load.elements" data="elbow"/></custom></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(SERVO.replace("</mujoco>", custom))
    with pytest.raises(ConfigurationError, match="2 values and 1 elements; write the file again"):
        ActuatorLaws(model, mujoco.MjData(model))
