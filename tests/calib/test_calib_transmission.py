"""Truth recovery of an elastic transmission: two bodies and a tendon move, and the calibration finds them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.refinement import refine
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.laws.setpoints import delay
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

STIFFNESS, SERVO_DAMPING, ROTOR = 15.0, 0.8, 0.02

LINK = """<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"/>"""

ARM = f"""
<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body><joint name="arm" axis="0 1 0" damping="0.05" armature="{ROTOR}"/>{LINK}</body></worldbody>
<actuator><position name="arm" joint="arm" kp="{STIFFNESS}" kv="{SERVO_DAMPING}"/></actuator></mujoco>"""

TWO_BODIES = """
<mujoco><option timestep="0.0002" integrator="implicitfast"/><worldbody>
<body><joint name="arm" axis="0 1 0" damping="{joint}"/>{link}</body>
<body><joint name="rotor" axis="0 1 0" armature="{rotor}"/><geom size=".01" mass="1e-6"/></body></worldbody>
<tendon><fixed stiffness="{stiffness}" damping="{damping}" springlength="{low} {high}">
<joint joint="rotor" coef="1"/><joint joint="arm" coef="-1"/></fixed></tendon>
<actuator><motor name="rotor" joint="rotor"/></actuator></mujoco>"""

NOISE_RAD = 1e-4
PERIOD_S, STEPS = 0.005, 25

COLUMNS = """
time: time
joints:
  - {name: arm, position: arm, target: arm.command, unit: rad}
"""

TRUE = {"stiffness": 80.0, "damping": 0.15}
"""Of the transmission."""


def recording(
    play: float, seconds: float, seed: int = 1, *, at_motor: bool = False, friction: float = 0.0
) -> dict[str, np.ndarray]:
    """Return time, position and command of an arm whose servo is damped at its motor.

    Its encoder, which the servo and the recording read, is at the link or at the motor. Where the motor has
    dry friction [N·m], the joint's damping is the motor's, too.
    """
    ends = {"low": -play / 2, "high": play / 2}
    text = TWO_BODIES.format(link=LINK, rotor=ROTOR, joint=0.08, **TRUE, **ends)
    if friction:
        # A constraint that creeps little.
        rubbing = f'damping="0.08" frictionloss="{friction}" solimpfriction="0.99 0.9999 0.001 0.5 2"'
        text = text.replace('damping="0.08"', "").replace(
            f'armature="{ROTOR}"', f'armature="{ROTOR}" {rubbing}'
        )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    rows = round(seconds / PERIOD_S)
    time = np.arange(rows) * PERIOD_S
    command = np.repeat(rng.uniform(-0.7, 0.7, rows), 60)[:rows]
    command[time < 0.1] = 0.0
    position = np.empty(rows)
    for row in range(rows):
        position[row] = data.qpos[int(at_motor)]
        for _ in range(STEPS):
            read = data.qpos[int(at_motor)]
            data.ctrl[0] = STIFFNESS * (command[row] - read) - SERVO_DAMPING * data.qvel[1]
            mujoco.mj_step(model, data)
    noisy = position + NOISE_RAD * rng.standard_normal(rows)
    return {"time": time, "arm": noisy, "arm.command": command}


def calibration_problem(
    tmp_path: Path, recorded: dict[str, np.ndarray], parameters: Mapping[str, str], step: str = "0.001"
) -> Problem:
    """Return the fit of parameters, how by kind, to a recording at a physics step [s]."""
    (tmp_path / "arm.xml").write_text(ARM.replace("0.001", step))
    (tmp_path / "columns.yaml").write_text(COLUMNS)
    lines = [f"  - {{kind: {kind}, elements: arm, {how}}}" for kind, how in parameters.items()]
    (tmp_path / "params.yaml").write_text("\n".join(["parameters:", *lines]) + "\n")
    work = calibration_input(
        FilesSettings(
            model=tmp_path / "arm.xml",
            data=[recorded],
            columns=tmp_path / "columns.yaml",
            parameters=tmp_path / "params.yaml",
            holdout_part=0.0,
        )
    )
    return Problem(work.robot, work.space, work.episodes, threads=1)


def fitted(problem: Problem) -> tuple[dict[str, float], float]:
    """Return fitted values by the parameters' kinds, and the latency [s]."""
    fit = refine(problem, problem.space.nominal, 0.0)
    return {p.kind: float(v) for p, v in zip(problem.space, fit.theta, strict=True)}, fit.latency_s


SEARCHED = {
    "dof_damping": "range: [0.01, 0.5]",
    "transmission_stiffness": "nominal: 160, range: [10, 2000]",
    "transmission_damping": "nominal: 0.05, range: [0.001, 2]",
}


@pytest.mark.parametrize("step", ["0.001", "0.0025"])
def test_a_spring_is_recovered(tmp_path: Path, step: str) -> None:
    """From twice the stiffness and a third of the damping; the joint's own damping is told apart from it.

    The recording has no latency: about half of a step is found, by which the engine moves too early.
    """
    found, latency_s = fitted(calibration_problem(tmp_path, recording(0.0, 2.5), SEARCHED, step))
    assert found["transmission_stiffness"] == pytest.approx(TRUE["stiffness"], rel=0.01)
    assert found["transmission_damping"] == pytest.approx(TRUE["damping"], rel=0.03)
    assert found["dof_damping"] == pytest.approx(0.08, rel=0.03)
    assert latency_s == pytest.approx(float(step) / 2, abs=3e-4)


AT_MOTOR = {"encoder_at_motor": "known: true"}


def held_out_rms(problem: Problem, found: Mapping[str, float], latency_s: float) -> float:
    """Return the error of another recording's whole prediction, root mean square [rad]."""
    members = ServoBatch(problem.robot, problem.space, 1, threads=1)
    members.set_parameters(np.array([[found[p.kind] for p in problem.space]]))
    other = recording(0.0, 2.5, seed=2, at_motor=True)
    steps = round(PERIOD_S / problem.robot.step_s)
    path = np.repeat(other["arm.command"][:-1], steps)[None, :, None]
    late = delay(path, np.array([latency_s / problem.robot.step_s]), path[:, 0])
    members.set_state(np.zeros(1), np.zeros(1))
    predicted, _ = members.advance(late, every=steps)
    return float(np.sqrt(np.mean((predicted[0, :, 0] - other["arm"][1:]) ** 2)))


def test_a_spring_is_recovered_by_an_encoder_at_the_motor(tmp_path: Path) -> None:
    """From twice the stiffness and a third of the damping, without any reading of the link.

    Held to be at the link, the same readings give another spring, and another motion is predicted worse.
    """
    recorded = recording(0.0, 2.5, at_motor=True)
    right = calibration_problem(tmp_path, recorded, SEARCHED | AT_MOTOR, "0.0025")
    found, latency_s = fitted(right)
    assert found["transmission_stiffness"] == pytest.approx(TRUE["stiffness"], rel=0.01)
    assert found["transmission_damping"] == pytest.approx(TRUE["damping"], rel=0.03)
    assert found["dof_damping"] == pytest.approx(0.08, rel=0.03)
    error = held_out_rms(right, found, latency_s)
    assert error < 3 * NOISE_RAD
    wrong = calibration_problem(tmp_path, recorded, SEARCHED, "0.0025")
    found, latency_s = fitted(wrong)
    assert found["transmission_stiffness"] > 3 * TRUE["stiffness"]
    assert held_out_rms(wrong, found, latency_s) > 20 * error


@pytest.mark.slow
@pytest.mark.parametrize("at_motor", [False, True], ids=["encoder at link", "encoder at motor"])
def test_friction_of_a_motor_is_recovered(tmp_path: Path, at_motor: bool) -> None:
    """0.15 N·m, beside spring and damping; held to be at the link, it comes out otherwise, and so does k."""
    recorded = recording(0.0, 4.0, at_motor=at_motor, friction=0.15)
    searched = SEARCHED | {"dof_frictionloss": "nominal: 0.05, range: [0.01, 0.5]"}
    searched |= AT_MOTOR if at_motor else {}
    at_the_motor = {"friction_at_motor": "known: true"}
    found, _ = fitted(calibration_problem(tmp_path, recorded, searched | at_the_motor))
    assert found["dof_frictionloss"] == pytest.approx(0.15, rel=0.03)
    assert found["transmission_stiffness"] == pytest.approx(TRUE["stiffness"], rel=0.02)
    assert found["dof_damping"] == pytest.approx(0.08, rel=0.05)
    wrong, _ = fitted(calibration_problem(tmp_path, recorded, searched))
    assert wrong["dof_frictionloss"] < 0.93 * 0.15
    assert abs(wrong["transmission_stiffness"] / TRUE["stiffness"] - 1) > 0.03


@pytest.mark.slow
def test_a_gap_is_recovered(tmp_path: Path) -> None:
    """With the stiffness. The tendon's damper acts within the gap, ours does not: its value is not asked."""
    play = {"transmission_play": "nominal: 0.01, range: [0, 0.1]"}
    found, _ = fitted(calibration_problem(tmp_path, recording(0.02, 4.0), SEARCHED | play))
    assert found["transmission_play"] == pytest.approx(0.02, rel=0.05)
    assert found["transmission_stiffness"] == pytest.approx(TRUE["stiffness"], rel=0.03)
