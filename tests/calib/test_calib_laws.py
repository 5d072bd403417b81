"""Truth recovery of laws of actuators and sensors: a loop of mj_step has them, the calibration finds them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from _pytest.mark import ParameterSet
from fakes.small_runs import small_run

from deal_hw.calib.data.problem import Problem
from deal_hw.calib.fit.output_error import Recipe, fit_output_error
from deal_hw.calib.fit.refinement import refine
from deal_hw.calib.pipeline.law_choice import screened_laws
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings

ARM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="0.3" frictionloss="0.15" armature="0.02"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"/></body>
</worldbody><actuator>{actuator}</actuator></mujoco>"""
SERVO = '<position name="shoulder" joint="shoulder" kp="25" kv="1" forcerange="-3 3"/>'
MOTOR = '<motor name="shoulder" joint="shoulder" ctrlrange="-3 3" forcerange="-3 3"/>'
NOISE_RAD = 1e-4
SECONDS, PERIOD_S, STEPS = 5.0, 0.01, 5

COLUMNS = """
time: time
joints:
  - {name: shoulder, position: shoulder, target: shoulder.command, unit: rad"""

COMMON = {"damping": ("dof_damping", 0.3, 0.4), "frictionloss": ("dof_frictionloss", 0.15, 0.12)}
"""Searched beside each law: kind, value in the model and true value."""

LAWS: Mapping[str, tuple[str, float, tuple[float, float]]] = {
    "friction_stribeck": ("dof_friction_stribeck", 0.25, (1e-3, 1.0)),
    "stribeck_speed": ("dof_stribeck_speed", 0.4, (0.05, 2.0)),
    "friction_load": ("dof_friction_load", 0.08, (1e-3, 0.4)),
    "free_speed": ("motor_free_speed", 6.0, (2.0, 40.0)),
    "lag": ("command_lag", 0.02, (1e-3, 0.1)),
    "asymmetry": ("command_asymmetry", 0.15, (-0.4, 0.4)),
    "dead_zone": ("command_dead_zone", 0.05, (0.0, 0.3)),
    "encoder_scale": ("encoder_scale", 1.2, (0.5, 2.0)),
    "servo_dead_zone": ("servo_dead_zone", 0.02, (0.0, 0.2)),
    "servo_punch": ("servo_punch", 0.3, (0.0, 2.0)),
}
"""Laws by the last part of their names: kind, true value, range."""


def recording(
    actuator: str, true: Mapping[str, float], seed: int, slow_s: float = 0.0
) -> dict[str, np.ndarray]:
    """Return time, position and command of a robot that mj_step and the equations move.

    For the first ``slow_s`` it moves slowly, by 0.15 rad at 0.3 Hz and 0.08 rad at 0.7 Hz.
    """
    model = mujoco.MjModel.from_xml_string(ARM.format(actuator=actuator))
    data = mujoco.MjData(model)
    model.dof_damping[0], coulomb = COMMON["damping"][2], COMMON["frictionloss"][2]
    rng = np.random.default_rng(seed)
    rows = round(SECONDS / PERIOD_S)
    time = np.arange(rows) * PERIOD_S
    phase, frequency = rng.uniform(0, 2 * np.pi, 5), np.geomspace(0.2, 2.5, 5)
    wave = np.sin(2 * np.pi * np.outer(time, frequency) + phase).sum(axis=1)
    command = (0.3 if actuator == MOTOR else 0.4) * wave
    slow_wave = np.sin(2 * np.pi * np.outer(time, (0.3, 0.7)) + phase[:2]) @ (0.15, 0.08)
    command = np.where(time < slow_s, slow_wave, command)
    command[time < 0.1] = 0.0
    position, acting = np.empty(rows), 0.0
    load, scale = true.get("friction_load", 0.0), true.get("encoder_scale", 1.0)
    stall = float(model.actuator_forcerange[0, 1])
    for step in range(rows * STEPS):
        row = step // STEPS
        if step % STEPS == 0:
            position[row] = scale * data.qpos[0]
        sent = float(command[row])
        if "dead_zone" in true:
            sent = math.copysign(max(abs(sent) - true["dead_zone"], 0.0), sent)
        sent *= 1 + math.copysign(true.get("asymmetry", 0.0), sent)
        lag_s = true.get("lag", 0.0)
        # The command that is held from here on has acted for one step at its end.
        acting = sent + (acting - sent) * math.exp(-0.002 / lag_s) if lag_s else sent
        speed = float(data.qvel[0])
        slow = math.exp(-((speed / true.get("stribeck_speed", 0.1)) ** 2))
        opposed = abs(-data.qfrc_bias[0] - data.qfrc_actuator[0])
        model.dof_frictionloss[0] = coulomb + load * opposed + true.get("friction_stribeck", 0.0) * slow
        if "free_speed" in true:
            lost = stall * speed / true["free_speed"]
            model.actuator_forcerange[0] = -stall - lost, stall - lost
        at = float(data.qpos[0])
        data.ctrl[0] = acting if actuator == MOTOR else at + servo_error(acting, at, true)
        if step == 0:
            mujoco.mj_forward(model, data)
        mujoco.mj_step(model, data)
    noisy = position + NOISE_RAD * rng.standard_normal(rows)
    return {"time": time, "shoulder": noisy, "shoulder.command": command}


def servo_error(goal: float, position: float, true: Mapping[str, float]) -> float:
    """Return the error that acts at 25 N·m/rad."""
    zone, punch = true.get("servo_dead_zone", 0.0), true.get("servo_punch", 0.0)
    count = true.get("servo_resolution")
    error = goal - position if count is None else (round(goal / count) - round(position / count)) * count
    return math.copysign(abs(error) - zone + punch / 25, error) if abs(error) > zone else 0.0


def recovered(
    tmp_path: Path,
    actuator: str,
    laws: Mapping[str, float],
    given: Mapping[str, float] | None = None,
    others: Sequence[str] = (),
    slow_s: float = 0.0,
) -> dict[str, float]:
    """Return fitted values over true ones; the fit begins at twice or half of a law's value.

    Args:
        tmp_path: Folder of the model and its parameters.
        actuator: The actuator.
        laws: Its laws, which are searched.
        given: Its laws that are known.
        others: Entries of further parameters, whose values are returned as they are.
        slow_s: Time of slow moves at the beginning [s].
    """
    given = given or {}
    model = tmp_path / "arm.xml"
    model.write_text(ARM.format(actuator=actuator))
    lines = ["parameters:", *(f"  - {{kind: {kind}, elements: shoulder}}" for kind, _, _ in COMMON.values())]
    for k, name in enumerate(laws):
        kind, value, (low, high) = LAWS[name]
        first = min(max(value * (2.0 if k % 2 else 0.5), 1.01 * low), 0.99 * high)
        scale = "linear" if low <= 0 else "log"
        ends = f"range: [{low}, {high}], scale: {scale}"
        lines.append(f"  - {{kind: {kind}, elements: shoulder, nominal: {first}, {ends}}}")
    lines += [f"  - {{kind: {name}, elements: shoulder, known: {value}}}" for name, value in given.items()]
    (tmp_path / "params.yaml").write_text("\n".join([*lines, *others]) + "\n")
    columns = tmp_path / "columns.yaml"
    columns.write_text(COLUMNS + (", target_unit: Nm}\n" if actuator == MOTOR else "}\n"))
    work = calibration_input(
        FilesSettings(
            model=model,
            data=[recording(actuator, {**laws, **given}, 1, slow_s)],
            columns=columns,
            parameters=tmp_path / "params.yaml",
            holdout_part=0.0,
            latency=0.0,
        )
    )
    problem = Problem(work.robot, work.space, work.episodes, threads=1, fixed_latency_s=0.0)
    fit = refine(problem, problem.space.nominal, 0.0)
    true = {f"shoulder.{name}": value for name, value in laws.items()}
    true |= {f"shoulder.{name}": value for name, (_, _, value) in COMMON.items()}
    return {
        name: float(v) / true.get(name, 1.0) for name, v in zip(problem.space.names, fit.theta, strict=True)
    }


def slow(actuator: str, names: list[str]) -> ParameterSet:
    """Return a case that is tested by `make test-slow`."""
    return pytest.param(actuator, names, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("actuator", "names"),
    [
        slow(SERVO, ["friction_stribeck", "stribeck_speed"]),
        slow(SERVO, ["friction_load"]),
        slow(SERVO, ["free_speed"]),
        (SERVO, ["lag"]),
        slow(SERVO, ["servo_dead_zone"]),
        slow(SERVO, ["servo_punch"]),
        (MOTOR, ["asymmetry"]),
        (MOTOR, ["dead_zone"]),
        (MOTOR, ["encoder_scale"]),
        slow(SERVO, ["friction_stribeck", "stribeck_speed", "friction_load"]),
        slow(SERVO, ["friction_stribeck", "stribeck_speed", "lag"]),
        slow(SERVO, ["friction_load", "free_speed"]),
        slow(MOTOR, ["asymmetry", "lag"]),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, list) else value[1:6],
)
def test_laws_are_recovered(tmp_path: Path, actuator: str, names: list[str]) -> None:
    """Each law, and pairs, to 5 % with damping and dry friction to 5 %, at a noise of 0.1 mrad."""
    found = recovered(tmp_path, actuator, {name: LAWS[name][1] for name in names})
    assert found == pytest.approx(dict.fromkeys(found, 1.0), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("names", [["servo_dead_zone", "servo_punch"], ["servo_punch", "servo_dead_zone"]])
def test_slow_moves_tell_a_dead_zone_from_a_punch(tmp_path: Path, names: list[str]) -> None:
    """From half of one and twice the other: both to 2 %, where half of the recording is slow.

    Fast ones alone show only punch less gain times zone, -0.2 N·m here.
    """
    found = recovered(tmp_path, SERVO, {name: LAWS[name][1] for name in names}, slow_s=2.5)
    assert found == pytest.approx(dict.fromkeys(found, 1.0), rel=0.02)


@pytest.mark.slow
def test_a_servo_that_reads_counts_is_fitted(tmp_path: Path) -> None:
    """4096 counts a turn and a dead zone of one: damping, friction and punch to 5 %."""
    count = 2 * math.pi / 4096
    given = {"servo_resolution": count, "servo_dead_zone": count}
    found = recovered(tmp_path, SERVO, {"servo_punch": LAWS["servo_punch"][1]}, given)
    assert found == pytest.approx(dict.fromkeys(found, 1.0), rel=0.05)


@pytest.mark.slow
def test_a_dead_zone_is_no_play_and_no_stiffness(tmp_path: Path) -> None:
    """All are searched, and dry friction: the zone has its value, the play none."""
    others = [
        "  - {kind: servo_play, elements: shoulder, nominal: 0.01, range: [0, 0.2]}",
        "  - {kind: servo_stiffness, elements: shoulder, nominal: 20, ratio: 3}",
    ]
    found = recovered(tmp_path, SERVO, {"servo_dead_zone": LAWS["servo_dead_zone"][1]}, others=others)
    assert found.pop("shoulder.play") < 1e-4
    assert found.pop("shoulder.servo_stiffness") == pytest.approx(25.0, rel=0.02)
    assert found == pytest.approx(dict.fromkeys(found, 1.0), rel=0.02)


@pytest.mark.slow
def test_friction_by_load_is_chosen_where_dry_friction_has_taken_its_place(tmp_path: Path) -> None:
    """Around that fit the law's effect says little, as on a real XL330; fitted to half it predicts the other.

    No other law explains a seventh of what is left, but friction by the motor's torque, a part of it.
    """
    (tmp_path / "arm.xml").write_text(ARM.format(actuator=SERVO))
    (tmp_path / "columns.yaml").write_text(COLUMNS + "}\n")
    entries = "".join(
        f"  - {{kind: {kind}, elements: shoulder, ratio: 50}}\n" for kind, _, _ in COMMON.values()
    )
    (tmp_path / "params.yaml").write_text(f"parameters:\n{entries}")
    work = calibration_input(
        FilesSettings(
            model=tmp_path / "arm.xml",
            data=[recording(SERVO, {"friction_load": 0.3}, seed) for seed in (1, 2)],
            columns=tmp_path / "columns.yaml",
            parameters=tmp_path / "params.yaml",
            holdout_part=0.0,
            latency=0.0,
        )
    )
    problem = Problem(work.robot, work.space, work.episodes, threads=1, fixed_latency_s=0.0)
    fit = fit_output_error(problem, problem.space.nominal, 0.0, Recipe(seconds=0.4))
    found = screened_laws(small_run(problem), problem, [fit.member], (0.4, 2.0))
    (law,) = found.chosen
    assert law.hypothesis.name == "friction that grows with load"
    shares = {name: gain.share for name, gain in found.gains.items()}
    of_load = shares.pop(law.hypothesis.name)
    assert of_load > 0.3 and shares.pop("friction that grows with the motor's torque") < 0.5 * of_load
    assert max(shares.values()) < 1 / 7
    assert law.start[0][-1] == pytest.approx(0.3, rel=0.5)
