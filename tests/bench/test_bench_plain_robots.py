"""Faults of the robots in plain MuJoCo, each by numbers that are worked out by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math

import mujoco
import numpy as np
import pytest

from deal_hw.errors import ConfigurationError
from deal_hw.testing import plain_effects
from deal_hw.testing.plain_effects import Plant, largest_zeros
from deal_hw.testing.plain_faults import (
    ASYMMETRY,
    BLIND,
    ENCODER_SCALE,
    FAULTS,
    FREE_SPEED,
    LAG_S,
    LOAD_FRICTION,
    NOISE,
    SERVO_DEAD_ZONE,
    WITH_MOTORS,
    WITHOUT,
    Fault,
)
from deal_hw.testing.plain_robots import KINDS, PlainRobot, can_have, make_robot, record
from deal_hw.types import FloatArray


def samples(robot: PlainRobot, number: int = 0, seconds: float = 3.0) -> FloatArray:
    """Return the columns of a recording: time, positions, commands."""
    return np.loadtxt(record(robot, number, seconds).splitlines(), delimiter=",", skiprows=1)


def plant(kind: str, fault: Fault, zero: FloatArray | float = 0.0) -> Plant:
    """Return a robot of seed 0 with a fault; motors have the largest command of their joints."""
    joints = KINDS[kind].joints
    effort = [joint.effort for joint in joints if joint.kp]
    robot = make_robot(kind, 0, fault)
    return Plant(robot.robot, [joint.name for joint in joints], fault, robot.truth, effort, zero)


def torque(of: Plant, position: float, speed: float, command: float) -> float:
    """Return the torque of the pendulum's drive in a state: MuJoCo computes it at the beginning of a step."""
    of.data.qpos[0], of.data.qvel[0] = position, speed
    of.step(np.array([command]))
    return float(of.data.actuator_force[0] * of.model.actuator_gear[0, 0])


def test_a_lagging_servo_is_at_63_percent_after_its_time_constant() -> None:
    """30 steps of 1 ms after a set-point of 1: 1 - 1 / e."""
    robot = plant("pendulum", "lag")
    for _ in range(round(LAG_S / robot.model.opt.timestep)):
        robot.step(np.array([1.0]))
    assert robot.data.act[0] == pytest.approx(1 - math.exp(-1), rel=1e-6)


def test_friction_by_load_is_a_fifth_of_the_torque() -> None:
    """A servo holds the pendulum away from its rest: the friction without load, and 0.2 of its torque."""
    robot = plant("pendulum", "load-friction")
    coulomb = make_robot("pendulum", 0).truth["pivot.frictionloss"]
    for _ in range(2000):
        robot.step(np.array([0.5]))
    held = abs(float(robot.data.qfrc_actuator[0]))
    # Gravity wants 0.25 kg * 9.81 m/s² * 0.15 m * sin(0.5) = 0.18 N·m, less what friction holds.
    assert 0.1 < held < 0.2
    assert robot.model.dof_frictionloss[0] == pytest.approx(coulomb + LOAD_FRICTION * held, rel=1e-3)


@pytest.mark.parametrize(("speed", "share"), [(0.0, 0.0), (0.2, 0.47135), (-2.0, 0.99993)])
def test_friction_rises_with_speed(speed: float, share: float) -> None:
    """As on a Panda's first joint: tanh(2.559 * 0.2) is 0.4714 of the friction at speed; none at rest."""
    robot = plant("pendulum", "friction-rise")
    coulomb = make_robot("pendulum", 0).truth["pivot.frictionloss"]
    robot.data.qvel[0] = speed
    robot.step(np.zeros(1))
    assert robot.model.dof_frictionloss[0] == pytest.approx(share * coulomb, rel=1e-4, abs=1e-8)


@pytest.mark.parametrize(("speed", "share"), [(0.0, 1.0), (FREE_SPEED / 2, 0.5), (-FREE_SPEED / 2, 1.5)])
def test_a_servo_on_a_limited_voltage_loses_torque_with_speed(speed: float, share: float) -> None:
    """The stall torque, 0.18 rad * 4 N·m/rad, at rest; half of it at half the free speed; more against it."""
    assert torque(plant("pendulum", "free-speed"), 0.0, speed, 5.0) == pytest.approx(share * 0.18 * 4.0)


def test_a_servo_with_a_dead_zone_has_no_torque_within_it() -> None:
    """None 4 mrad off; 10 mrad beyond the zone the stiffness times that, to either side."""
    stiffness = make_robot("pendulum", 0).truth["pivot.servo_stiffness"]
    robot = plant("pendulum", "servo-dead-zone")
    assert torque(robot, 0.3, 0.0, 0.304) == pytest.approx(0.0, abs=1e-12)
    for side in (-1, 1):
        found = torque(robot, 0.3, 0.0, 0.3 + side * (SERVO_DEAD_ZONE + 0.01))
        assert found == pytest.approx(side * 0.01 * stiffness)


@pytest.mark.parametrize(("command", "acts"), [(0.02, 0.0), (0.12, 0.1), (-0.12, -0.1)])
def test_a_motor_with_a_dead_zone_loses_small_commands(command: float, acts: float) -> None:
    """5 % of the pendulum's 0.4 N·m is 0.02 N·m."""
    gain = make_robot("pendulum", 0, "motor-dead-zone").truth["pivot.motor_gain"]
    assert torque(plant("pendulum", "motor-dead-zone"), 0.0, 0.0, command) == pytest.approx(gain * acts)


@pytest.mark.parametrize("command", [0.1, -0.1])
def test_a_motor_does_more_to_one_side(command: float) -> None:
    """1.12 times the command to one side, 0.88 times to the other."""
    gain = make_robot("pendulum", 0, "motor-asymmetry").truth["pivot.motor_gain"]
    found = torque(plant("pendulum", "motor-asymmetry"), 0.0, 0.0, command)
    assert found == pytest.approx(gain * command * (1 + math.copysign(ASYMMETRY, command)))


def test_an_encoder_reports_in_its_scale() -> None:
    """4271 counts for 4096, at the pole alone."""
    robot = plant("cart-pole", "encoder-scale")
    robot.data.qpos[:] = 0.3, 0.5
    np.testing.assert_allclose(robot.read(), [0.3, 0.5 * 4271 / 4096])
    assert pytest.approx(4271 / 4096) == ENCODER_SCALE


def test_a_blind_encoder_reports_nothing_of_its_gap() -> None:
    """No sample lies within it by more than five times the noise; of the right robot many do."""
    low, high = BLIND[0] + 5 * NOISE, BLIND[1] - 5 * NOISE
    seen = [samples(make_robot("pendulum", 0, fault))[:, 1] for fault in (None, "blind-encoder")]
    within = [np.mean((low < position) & (position < high)) for position in seen]
    assert within[0] > 0.1 and within[1] == 0.0
    outside = (seen[0] < BLIND[0] - 5 * NOISE) | (seen[0] > BLIND[1] + 5 * NOISE)
    np.testing.assert_array_equal(seen[0][outside], seen[1][outside])


def test_zeros_are_those_of_a_robot_that_friction_holds_off_its_rest() -> None:
    """A pendulum rests within friction / (m g l): it begins there and reports 0; recordings differ."""
    robot = make_robot("pendulum", 0, "zeros")
    model = mujoco.MjModel.from_xml_string(robot.robot)
    most = robot.truth["pivot.frictionloss"] / (0.25 * 9.81 * 0.15)
    assert largest_zeros(model, ["pivot"])[0] == pytest.approx(most, rel=1e-3) and 0.02 < most < 0.1
    switched_on = plant("pendulum", "zeros", -0.5)
    assert switched_on.data.qpos[0] == pytest.approx(0.5 * most)
    assert switched_on.read()[0] == pytest.approx(0.0, abs=1e-12)
    # A servo whose reading is its goal has no torque.
    switched_on.step(np.zeros(1))
    assert switched_on.data.actuator_force[0] == pytest.approx(0.0, abs=1e-9)


def test_each_recording_has_its_own_zero() -> None:
    """The servo holds the same readings against gravity of other angles: their means differ."""
    robot, right = make_robot("pendulum", 0, "zeros"), make_robot("pendulum", 0)
    shift = [float(np.mean(samples(robot, k)[:, 1] - samples(right, k)[:, 1])) for k in range(3)]
    assert min(abs(a - b) for a, b in itertools.combinations(shift, 2)) > 1e-4


@pytest.mark.parametrize("fault", FAULTS)
def test_the_model_lacks_the_fault_and_nothing_else(fault: Fault) -> None:
    """Joints, drives and torques at standstill of the model are the robot's."""
    kind = next(kind for kind in ("double-pendulum", "cart-pole") if can_have(kind, fault))
    robot = make_robot(kind, 1, fault)
    model, truth = (mujoco.MjModel.from_xml_string(text) for text in (robot.model, robot.robot))
    assert model.nu == truth.nu and (model.nv == truth.nv) is (fault != "motor-play")
    np.testing.assert_array_equal(model.actuator_forcerange, truth.actuator_forcerange)
    if fault in WITH_MOTORS:
        names = [model.actuator(i).name for i in range(model.nu)]
        np.testing.assert_allclose(model.actuator_gear[:, 0], 1.0)
        np.testing.assert_allclose(
            truth.actuator_gear[:, 0], [robot.truth[f"{name}.motor_gain"] for name in names]
        )
    assert (model.na, truth.na) == (0, truth.nu if fault == "lag" else 0)
    fields = {"frictionloss": "dof_frictionloss", "damping": "dof_damping", "armature": "dof_armature"}
    for name, field in fields.items():
        lacks, values = name in WITHOUT.get(fault, ()), getattr(model, field)
        assert not values.any() if lacks else values.all()


def test_a_fault_that_makes_no_sense_for_a_robot_is_refused() -> None:
    """An arm without servos falls onto itself, a cart's servo does not turn; a scale needs a free joint."""
    for kind, fault in (("arm", "motor-asymmetry"), ("cart-pole", "free-speed"), ("leg", "encoder-scale")):
        with pytest.raises(ConfigurationError, match="cannot have the fault"):
            make_robot(kind, 0, fault)  # type: ignore[arg-type]


def test_a_motor_without_its_fault_moves_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same commands, motors and noise without the zone: more than ten times the noise apart."""
    robot = make_robot("double-pendulum", 1, "motor-dead-zone")
    faulty = samples(robot)
    monkeypatch.setattr(plain_effects, "COMMANDS", {})
    right = samples(dataclasses.replace(robot))
    np.testing.assert_array_equal(faulty[:, 3:], right[:, 3:])
    assert np.abs(faulty[:, 1:3] - right[:, 1:3]).max() > 10 * NOISE
