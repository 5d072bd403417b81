"""Laws of actuators and sensors: hand-computed numbers, and a loop of mj_step that applies them by itself."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from fakes.law_robots import MOTOR, SERVO, batch, known, robot, swing

from deal_hw.errors import ConfigurationError
from deal_hw.parameters import ParameterSpace
from deal_hw.sim.engine.closed_loop import ClosedLoop
from deal_hw.sim.laws.commands import CommandLaws, lag
from deal_hw.sim.laws.friction import FrictionLaw
from deal_hw.sim.laws.motor import effort_range
from deal_hw.sim.parameters import check_space


def test_budget_of_friction_by_hand() -> None:
    """Kc .1, Kcs .2 at a speed where exp(-1) is left; motor 2, outside -1 N·m; factors .05, .1, .02, .04."""
    law = FrictionLaw(
        coulomb=np.array([[0.1]]),
        stribeck=np.array([[0.2]]),
        stribeck_speed=np.array([[0.5]]),
        motor=np.array([[0.05]]),
        external=np.array([[0.1]]),
        motor_stribeck=np.array([[0.02]]),
        external_stribeck=np.array([[0.04]]),
    )
    found = law.budget(np.array([[-0.5]]), np.array([[2.0]]), np.array([[-1.0]]))
    assert found[0, 0] == pytest.approx(0.1 + 0.2 + (0.2 + 0.08) / math.e)


def test_effort_at_half_the_free_speed_is_half_ahead_and_one_and_a_half_back() -> None:
    """Stall 4 N·m, free speed 6 rad/s, 3 rad/s; an infinite free speed changes nothing."""
    low, high = effort_range(np.array([[3.0, 3.0]]), np.array([[4.0, 4.0]]), np.array([[6.0, np.inf]]))
    np.testing.assert_allclose(low, [[-6.0, -4.0]])
    np.testing.assert_allclose(high, [[2.0, 4.0]])


def test_lag_after_one_time_constant_and_without_one() -> None:
    """A step of 1 is at 1 - 1/e after the time constant; a lag of 0 passes it."""
    out = lag(np.zeros((2, 1)), np.ones((2, 50, 1)), np.array([[0.05], [0.0]]), 0.001)
    assert out[0, 49, 0] == pytest.approx(1 - 1 / math.e)
    np.testing.assert_array_equal(out[1], 1.0)


def test_motor_commands_by_hand() -> None:
    """Dead zone .1, then 20 % more ahead and less back, then at most .5."""
    laws = CommandLaws(dead_zone=np.array([[0.1]]), asymmetry=np.array([[0.2]]), saturation=np.array([[0.5]]))
    given = np.array([0.05, 0.3, -0.3, 1.0])[None, :, None]
    out, _ = laws.act(given, laws.memory(given[:, 0]), 0.001)
    np.testing.assert_allclose(out[0, :, 0], [0.0, 0.24, -0.16, 0.5])


@pytest.mark.parametrize(
    "kinds",
    [
        {"dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3},
        {"dof_friction_load": 0.1},
        {"dof_friction_motor": 0.15, "dof_friction_external": 0.05, "dof_friction_motor_stribeck": 0.1},
        {"motor_free_speed": 2.5},
    ],
)
def test_a_batch_equals_a_loop_of_mj_step_with_the_law(tmp_path: Path, kinds: dict[str, float]) -> None:
    """The loop writes friction and effort limit of the shoulder by itself, from the equations."""
    model = robot(tmp_path, SERVO)
    members = batch(model, *(known(kind, "shoulder", value) for kind, value in kinds.items()), count=2)
    path = swing(400, 2)
    members.set_state(np.array([0.2, -0.1]), np.zeros(2))
    found, _ = members.advance(np.repeat(path, 2, axis=0), every=1)

    m = mujoco.MjModel.from_xml_string(SERVO)
    d = mujoco.MjData(m)
    d.qpos[:], d.ctrl[:] = [0.2, -0.1], path[0, 0]
    mujoco.mj_forward(m, d)
    expected = np.empty((400, 2))
    for step in range(400):
        w, motor, outside = d.qvel[0], d.qfrc_actuator[0], -d.qfrc_bias[0]
        slow = math.exp(-((w / kinds.get("dof_stribeck_speed", 0.1)) ** 2))
        both = kinds.get("dof_friction_load", 0.0)
        load = abs(
            kinds.get("dof_friction_external", both) * outside - kinds.get("dof_friction_motor", both) * motor
        )
        rest = kinds.get("dof_friction_stribeck", 0.0) + abs(
            kinds.get("dof_friction_motor_stribeck", 0.0) * motor
        )
        m.dof_frictionloss[0] = 0.1 + load + slow * rest
        if "motor_free_speed" in kinds:
            lost = 4.0 * w / kinds["motor_free_speed"]
            m.actuator_forcerange[0] = -4.0 - lost, 4.0 - lost
        d.ctrl[:] = path[0, step]
        mujoco.mj_step(m, d)
        expected[step] = d.qpos
    np.testing.assert_allclose(found[0], expected, atol=1e-12)
    np.testing.assert_array_equal(found[0], found[1])
    plain = batch(model)
    plain.set_state(np.array([0.2, -0.1]), np.zeros(2))
    assert np.abs(plain.advance(path, every=1)[0] - found[:1]).max() > 1e-3


def test_a_window_does_not_depend_on_the_one_before(tmp_path: Path) -> None:
    """Friction by load needs the torques of the step before; at the start these are the state's own."""
    members = batch(robot(tmp_path, SERVO), known("dof_friction_load", "shoulder", 0.1))
    runs = []
    for before in (0, 130):
        if before:
            members.set_state(np.array([1.0, 1.0]), np.array([3.0, -2.0]))
            members.advance(swing(before, 2))
        members.set_state(np.array([0.2, -0.1]), np.zeros(2))
        runs.append(members.advance(swing(200, 2), every=10)[0])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_laws_end_with_the_parameters_that_set_them(tmp_path: Path) -> None:
    """New values start from the model's friction and limits, not from what the law wrote last."""
    model = robot(tmp_path, SERVO)
    law = (known("dof_friction_stribeck", "shoulder", 0.2), known("motor_free_speed", "elbow", 3.0))
    members, theta = batch(model, *law), np.array([[0.05]])
    runs = []
    for _ in range(2):
        members.set_parameters(theta)
        members.set_state(np.zeros(2), np.zeros(2))
        runs.append(members.advance(swing(150, 2), every=5)[0])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_motor_at_full_command_ends_at_its_free_speed(tmp_path: Path) -> None:
    """8 rad/s at the joint, behind a gear of 2."""
    members = batch(robot(tmp_path, MOTOR), known("motor_free_speed", "wheel", 8.0))
    _, velocity = members.advance(np.ones((1, 5000, 1)), every=5000)
    assert velocity[0, 0, 0] == pytest.approx(8.0, rel=1e-3)


def test_scale_of_an_encoder(tmp_path: Path) -> None:
    """A servo brings the reading to its set-point; states go in and come out as they are read."""
    model = robot(
        tmp_path, SERVO.replace('frictionloss="0.1"', "").replace("<option ", '<option gravity="0 0 0" ')
    )
    members = batch(model, known("encoder_scale", "shoulder", 1.25), known("encoder_bias", "shoulder", 0.1))
    members.set_state(np.array([0.35, 0.0]), np.array([0.5, 0.0]))
    np.testing.assert_allclose(members.position, [[0.35, 0.0]])
    np.testing.assert_allclose(members.velocity, [[0.5, 0.0]])
    np.testing.assert_allclose(members.true_joints(members.position), [[0.2, 0.0]])
    assert members.batch.bind("qvel")[0, 0] == pytest.approx(0.4)
    position, velocity = members.advance(np.tile([0.6, 0.0], (1, 3000, 1)), every=3000)
    assert position[0, 0, 0] == pytest.approx(0.6, abs=1e-4)
    assert members.batch.bind("qpos")[0, 0] == pytest.approx(0.4, abs=1e-4)
    np.testing.assert_allclose(velocity[0, 0], 0.0, atol=1e-4)


def test_a_closed_loop_applies_lag_and_play_as_an_open_one(tmp_path: Path) -> None:
    """Ten control periods of ten steps, or one path."""
    model = robot(tmp_path, SERVO)
    laws = (known("command_lag", "shoulder", 0.03), known("servo_play", "elbow", 0.05))
    targets = swing(100, 2)[:, ::10]
    open_batch, closed_batch = batch(model, *laws), batch(model, *laws)
    path = np.repeat(targets, 10, axis=1)
    acting, _ = open_batch.commands.act(path, open_batch.commands.memory(np.zeros((1, 2))), 0.002)
    open_batch.set_state(np.zeros(2), np.zeros(2))
    expected, _ = open_batch.advance(acting, every=10)
    closed_batch.set_state(np.zeros(2), np.zeros(2))
    loop = ClosedLoop(closed_batch, 10)
    loop.restart(np.zeros((1, 2)), np.zeros(1))
    found = [loop.advance(targets[:, k])[0][:, 0] for k in range(10)]
    np.testing.assert_allclose(np.stack(found, axis=1), expected, atol=1e-12)


def test_two_laws_of_one_load_are_refused(tmp_path: Path) -> None:
    """Friction by both torques, and again by the motor's."""
    model = robot(tmp_path, SERVO)
    space = ParameterSpace(
        [known("dof_friction_load", "elbow", 0.1), known("dof_friction_motor", "elbow", 0.1)]
    )
    with pytest.raises(ConfigurationError, match=r"both set friction of 'elbow' by load.*keep one"):
        check_space(model.model, space)


def test_a_free_speed_needs_an_effort_limit(tmp_path: Path) -> None:
    """The message says what to write."""
    model = robot(tmp_path, SERVO.replace('forcerange="-4 4"', ""))
    space = ParameterSpace([known("motor_free_speed", "shoulder", 2.0)])
    with pytest.raises(
        ConfigurationError, match="no effort limit that could fall with speed; give it a `for"
    ):
        check_space(model.model, space)
