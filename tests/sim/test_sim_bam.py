"""Servos as parameters of BAM, and as motors of Isaac Lab and mjlab: numbers by hand, and the same motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from fakes.law_robots import SERVO, known, robot, swing

from deal_hw.calibration import CalibrationResult
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import RobotModel
from deal_hw.sim.mjcf.bam import bam_parameters
from deal_hw.sim.mjcf.exports import actuator_tables, laws_without_a_field

# Shoulder: kp 20, kv 1, 4 N·m; joint damping .05, friction .1, armature .01. Elbow: kp 10, kv .5, 3 N·m.
LOAD = {
    "m1": {},
    "m2": {"dof_friction_stribeck": 0.2, "dof_stribeck_speed": 0.3},
    "m3": {"dof_friction_load": 0.04},
    "m4": {"dof_friction_load": 0.04, "dof_friction_load_stribeck": 0.06, "dof_friction_stribeck": 0.2},
    "m5": {"dof_friction_motor": 0.04, "dof_friction_external": 0.02, "dof_friction_stribeck": 0.2},
}


def result_of(kinds: Mapping[str, float], *more: Parameter) -> CalibrationResult:
    """Return a result with known laws of the shoulder, and a searched stiffness of 24 N·m/rad."""
    free = Parameter.around("shoulder.stiffness", "servo_stiffness", ("shoulder",), "N·m/rad", 20.0)
    space = ParameterSpace([free, *(known(kind, "shoulder", v) for kind, v in kinds.items()), *more])
    return CalibrationResult(
        method="test",
        space=space,
        estimate=np.array([24.0]),
        interval=np.array([[23.0, 25.0]]),
        verdicts=("identifiable",),
        latency_s=0.0125,
        latency_interval_s=(0.011, 0.0145),
    )


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    """Two position servos."""
    return robot(tmp_path, SERVO)


def test_a_servo_by_hand(arm: RobotModel) -> None:
    """15 V times .9625 are 14.4375 V: over 2.5 rad/s and 4 N·m that is a motor."""
    found = bam_parameters(arm, result_of({"motor_free_speed": 2.5, "command_delay": 0.004}))
    entry = found["joints"]["shoulder"]
    assert entry["kt"] == pytest.approx(14.4375 / 2.5) and entry["model"] == "m1"
    assert entry["R"] == pytest.approx(14.4375 / 2.5 * 14.4375 / 4)
    # Stall at full duty, none left at the free speed; 24 N·m/rad in small.
    stall = entry["kt"] * entry["vin"] * entry["max_pwm"] / entry["R"]
    assert stall == pytest.approx(4.0)
    assert stall - entry["kt"] ** 2 / entry["R"] * 2.5 == pytest.approx(0.0, abs=1e-12)
    gain = entry["kt"] * entry["vin"] * entry["kp"] * entry["error_gain"] / entry["R"]
    assert gain == pytest.approx(24.0)
    # kt^2 / R is 1.6: .55 more than the servo's 1 and the joint's .05.
    assert entry["friction_viscous"] == 0.0 and entry["friction_base"] == 0.1 and entry["armature"] == 0.01
    assert any("0.55 of back-EMF" in text for text in entry["cannot_express"])
    assert entry["command_delay"] == pytest.approx(0.0165) and entry["actuator"] == "mx64"


def test_damping_is_back_emf_where_no_free_speed_is_known(arm: RobotModel) -> None:
    """Elbow: .5 N·m·s/rad and 3 N·m are 6 rad/s; the joint's own .05 stays friction."""
    entry = bam_parameters(arm, result_of({}))["joints"]["elbow"]
    assert entry["kt"] == pytest.approx(14.4375 / 6) and entry["kt"] ** 2 / entry["R"] == pytest.approx(0.5)
    assert entry["friction_viscous"] == pytest.approx(0.05)
    assert any("taken as the motor's back-EMF" in text for text in entry["cannot_express"])


@pytest.mark.parametrize("name", LOAD)
def test_friction_is_budgeted_as_bam_does(arm: RobotModel, name: str) -> None:
    """BAM's formula with the exported numbers gives the friction that our engine writes."""
    result = result_of(LOAD[name] | {"motor_free_speed": 6.0})
    entry = bam_parameters(arm, result)["joints"]["shoulder"]
    assert entry["model"] == name and entry.get("alpha", 2.0) == 2.0
    members = ServoBatch(arm, result.space, 1, threads=1)
    members.set_state(np.array([0.3, -0.2]), np.array([-0.2, 0.4]))
    outputs = {field: members.batch.bind(field) for field in ("qvel", "qfrc_actuator", "qfrc_bias")}
    members.batch.forward()
    laws = members._steps
    assert laws is not None
    laws.write()
    written = float(members.batch.expand("dof_frictionloss")[0, 0])
    speed, motor, bias = (float(outputs[field][0, 0]) for field in ("qvel", "qfrc_actuator", "qfrc_bias"))
    assert written == pytest.approx(_bam_friction(entry, speed, motor, -bias))


def _bam_friction(entry: Mapping[str, Any], speed: float, motor: float, external: float) -> float:
    """Return the friction of BAM's models m1 to m5, from its paper."""

    def of(name: str) -> float:
        return float(entry.get(name, 0.0))

    near = 0.0
    if "dtheta_stribeck" in entry:
        near = float(np.exp(-(abs(speed / of("dtheta_stribeck")) ** of("alpha"))))
    total = of("friction_base") + near * of("friction_stribeck")
    if entry["model"] == "m5":
        total += abs(external * of("load_friction_external") - motor * of("load_friction_motor"))
        total += near * abs(
            external * of("load_friction_external_stribeck") - motor * of("load_friction_motor_stribeck")
        )
    else:
        load = abs(external - motor)
        total += load * (of("load_friction_base") + near * of("load_friction_stribeck"))
    return float(total)


def test_what_is_no_servo_of_a_known_size_is_left_out(tmp_path: Path) -> None:
    """Without a limit, without damping, or a motor: each with its reason."""
    text = SERVO.replace('kp="20" kv="1" forcerange="-4 4"', 'kp="20" kv="1"')
    text = text.replace('kp="10" kv="0.5"', 'kp="10"')
    found = bam_parameters(robot(tmp_path, text), result_of({}))
    assert not found["joints"]
    assert "no effort limit" in found["left_out"]["shoulder"]
    assert "neither motor_free_speed nor a servo damping" in found["left_out"]["elbow"]


def test_what_other_programs_lose_stands_in_their_tables(tmp_path: Path) -> None:
    """A law in one line each, also a filter and an offset that only the MJCF has."""
    text = SERVO.replace('joint="elbow" kp="10"', 'joint="elbow" timeconst=".05" kp="10"')
    text = text.replace(
        '<position name="shoulder" joint="shoulder" kp="20" kv="1"',
        '<general name="shoulder" joint="shoulder" gainprm="20" biastype="affine" biasprm=".3 -20 -1"',
    )
    laws = {"dof_friction_load": 0.04, "command_lag": 0.02, "servo_dead_zone": 0.01}
    result = result_of({"motor_free_speed": 6.0, **laws})
    table = actuator_tables(robot(tmp_path, text), result)
    for place in ("isaac_lab", "mjlab", "isaac_lab_motors", "mjlab_motors"):
        lost = table[place]["cannot_express"]
        assert "shoulder.dof_friction_load = 0.04 - (dof_friction_load)" in lost
        assert "shoulder.command_lag = 0.02 - (command_lag)" in lost
        assert "shoulder.servo_dead_zone = 0.01 - (servo_dead_zone)" in lost
        assert "elbow: lag of 0.05 s of its command, the filter of the MJCF" in lost
        assert any(line.startswith("shoulder: constant effort of 0.3") for line in lost)
        assert any("motor_free_speed" in line for line in lost) is not place.endswith("_motors")
    assert laws_without_a_field(result) == [f"shoulder.{kind}" for kind in laws]
    bam = bam_parameters(robot(tmp_path, SERVO), result)["joints"]["shoulder"]["cannot_express"]
    assert "shoulder.servo_dead_zone = 0.01 - (servo_dead_zone)" in bam
    (isaac,) = table["isaac_lab_motors"]["actuators"]
    assert isaac["saturation_effort"] == isaac["effort_limit"] == 4.0 and isaac["velocity_limit"] == 6.0
    assert isaac["stiffness"] == 24.0 and isaac["damping"] == pytest.approx(1.05)
    (mjlab,) = table["mjlab_motors"]["actuators"]
    assert mjlab["damping"] == 1.0 and mjlab["viscous_damping"] == 0.05 and mjlab["velocity_limit"] == 6.0
    # 12.5 ms at 2 ms a step.
    assert mjlab["delay_max_lag"] == 6 and mjlab["saturation_effort"] == 4.0


@pytest.mark.parametrize(("size", "tolerance"), [(0.2, 1e-9), (1.0, 3e-3)])
def test_bams_servo_moves_as_the_calibrated_one(arm: RobotModel, size: float, tolerance: float) -> None:
    """kt^2 / R is the servo's damping. In the large swing the limit acts: there MuJoCo damps explicitly."""
    result = result_of({"motor_free_speed": 4.0})
    entry = bam_parameters(arm, result)["joints"]["shoulder"]
    assert entry["friction_viscous"] == pytest.approx(0.05)
    members = ServoBatch(arm, result.space, 1, threads=1)
    members.set_parameters(np.array([[24.0]]))
    members.set_state(np.array([0.3 * size, -0.2]), np.zeros(2))
    path = size * swing(400, 2)
    found = members.advance(path, every=1)[0][0]
    model = mujoco.MjModel.from_xml_string(
        SERVO.replace(
            '<position name="shoulder" joint="shoulder" kp="20" kv="1" forcerange="-4 4"/>',
            '<motor name="shoulder" joint="shoulder"/>',
        )
    )
    # The back-EMF, as damping: MuJoCo integrates that implicitly, as a servo's below its limit.
    model.dof_damping[0] += entry["kt"] ** 2 / entry["R"]
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3 * size, -0.2]
    moved = []
    for row in path[0]:
        duty = np.clip(entry["kp"] * entry["error_gain"] * (row[0] - data.qpos[0]), -0.9625, 0.9625)
        data.ctrl[:] = entry["kt"] * entry["vin"] * duty / entry["R"], row[1]
        mujoco.mj_step(model, data)
        moved.append(data.qpos.copy())
    np.testing.assert_allclose(moved, found, atol=tolerance)
    assert np.ptp(found[:, 0]) > 0.5 * size
