"""What no rollout sees is refused before any search; held-out errors in physical units."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from deal_hw.calib.data.checks import compute_sensitivity, jumps, require_sensitive
from deal_hw.calib.data.problem import Problem
from deal_hw.calib.validation.metrics import HeldOut
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.recordings.episode import SampledEpisode

SLIDER = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0" damping="4"/>
      <geom type="sphere" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="50" kv="1" forcerange="-100 100"/></actuator>
</mujoco>
"""
STD = np.array([0.001, 1.0])


@pytest.fixture
def robot(tmp_path: Path) -> RobotModel:
    """A slider with a servo, recorded at 100 Hz."""
    path = tmp_path / "slider.xml"
    path.write_text(SLIDER, encoding="utf-8")
    rates = sampling(0.01, 0.002, 0.4)
    return load_model(describe(path, compile_mjcf(path), ("rail",), ("rail",), rates), rates.step_s)


def steps_of(robot: RobotModel, T: int = 200) -> SampledEpisode:
    """Return an episode at rest in which the command steps by 5 cm; the positions are all zero."""
    steps = 5 * (T - 1)
    rows = np.ones((steps, 1))
    square = 0.05 * np.sign(np.sin(2 * np.pi * np.arange(steps) / 250))[:, None]
    return SampledEpisode(
        step_s=robot.step_s,
        sample=5 * np.arange(T),
        position=np.zeros((T, 1)),
        velocity=np.zeros((T, 1)),
        target=square,
        stiffness=50 * rows,
        damping=rows,
        effort_limit=100 * rows,
        speed_limit=rows * np.inf,
        usable=np.ones(T, dtype=bool),
        start_setpoint=np.zeros(1),
    )


def test_parameters_are_told_apart_by_what_they_change(robot: RobotModel) -> None:
    """The gain is seen, a friction of 1e-6 N hardly, a force limit that is never reached not at all."""
    space = ParameterSpace(
        [
            Parameter.around("gain", "servo_stiffness", ("drive",), "N/m", 50.0),
            Parameter.around("friction", "dof_frictionloss", ("rail",), "N", 1e-6),
            Parameter(
                name="limit",
                kind="servo_effort_limit",
                elements=("drive",),
                unit="N",
                nominal=100.0,
                low=50.0,
                high=200.0,
            ),
        ]
    )
    found = compute_sensitivity(Problem(robot, space, [steps_of(robot)], threads=1, known_std=STD))
    assert found.unseen == ("limit",) and found.faint == ("friction",)
    assert found.effect[0] > 10
    with pytest.raises(ConfigurationError, match="depends on limit"):
        require_sensitive(found)


def test_heldout_errors_are_in_metres(robot: RobotModel) -> None:
    """At rest a prediction that never moves is right; one that follows the command is off by less than it."""
    space = ParameterSpace([Parameter.around("gain", "servo_stiffness", ("drive",), "N/m", 50.0, ratio=1e8)])
    candidates = {"model": (np.array([50.0]), 0.0), "slack": (np.array([1e-7]), 0.0)}
    held_out = HeldOut(robot, space, [steps_of(robot)], window_s=0.5, threads=1)
    found = held_out.errors(candidates)
    assert found.names == ("rail",) and set(found.rmse) == {"model", "slack", "null"}
    assert found.mean()["null"] == 0.0 and found.mean()["slack"] == pytest.approx(0.0, abs=1e-8)
    assert 0.01 < found.mean()["model"] < 0.1
    assert found.mean()["model"] == pytest.approx(found.pooled()["model"])
    assert found.to_json()["by_coordinate"]["model"]["rail"] == pytest.approx(found.rmse["model"][0])
    assert not math.isnan(found.window_s)
    # What is known of a candidate is not simulated again.
    steps = held_out.problem.steps
    again = held_out.errors({"model": candidates["model"], "stiffer": (np.array([60.0]), 0.0)})
    assert again.rmse["model"] == found.rmse["model"] and set(again.nrmse) == {"model", "stiffer", "null"}
    assert held_out.problem.steps - steps == steps / 2


KNEE = """
<mujoco>
  <option timestep="0.0025" integrator="implicitfast" {solver}/>
  <worldbody>
    <site name="above" pos="0 0 0.1"/>
    <body>
      <joint name="knee" axis="0 1 0" armature="0.03" frictionloss="0.5"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
      <site name="below" pos="0 0 -0.1"/>
      <body pos="0 0 -0.3">
        <joint name="ankle" axis="0 1 0" armature="0.03" frictionloss="0.5"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/>
        <site name="toe" pos="0 0 -0.1"/>
      </body>
      <site name="shin" pos="0 0 -0.2"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rod" frictionloss="15"><site site="above"/><site site="below"/></spatial>
    <spatial name="strap" frictionloss="15"><site site="shin"/><site site="toe"/></spatial>
  </tendon>
  <actuator>
    <position name="knee" joint="knee" kp="20" kv="2"/>
    <position name="ankle" joint="ankle" kp="20" kv="2"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("solver", "smooth"),
    [
        ('iterations="2"', False),
        ('tolerance="1e-15" iterations="200" ls_tolerance="1e-6" ls_iterations="200"', True),
    ],
)
def test_a_solver_that_stops_early_is_seen_by_what_jumps(solver: str, smooth: bool, tmp_path: Path) -> None:
    """Two frictions at each of two joints: predictions jump where the solver may not converge, only there."""
    path = tmp_path / "knee.xml"
    path.write_text(KNEE.format(solver=solver), encoding="utf-8")
    rates, names = sampling(0.01, 0.0025, 0.4), ("knee", "ankle")
    robot = load_model(describe(path, compile_mjcf(path), names, names, rates), rates.step_s)
    T, steps = 200, 4 * 199
    rows = np.ones((steps, 2))
    angle = -1.2 + 0.4 * np.sin(np.arange(steps) * 0.0025 * 3.0)[:, None] * [1.0, -1.0]
    found = np.concatenate([angle[:1], angle[3::4]])
    episode = SampledEpisode(
        step_s=robot.step_s,
        sample=4 * np.arange(T),
        position=found,
        velocity=np.gradient(found, 0.01, axis=0),
        target=angle + 0.2 * np.sign(np.cos(np.arange(steps) * 0.0025 * 3.0))[:, None] * [1.0, -1.0],
        stiffness=20 * rows,
        damping=2 * rows,
        effort_limit=rows * np.inf,
        speed_limit=rows * np.inf,
        usable=np.ones(T, dtype=bool),
        start_setpoint=np.full(2, -1.2),
    )
    space = ParameterSpace(
        [
            Parameter.around("rod", "tendon_frictionloss", ("rod",), "N", 15.0),
            Parameter.around("knee", "dof_frictionloss", ("knee",), "N·m", 0.5),
        ]
    )
    problem = Problem(robot, space, [episode], known_std=np.array([1e-3, 1e-3, 1.0, 1.0]), threads=1)
    assert (jumps(problem) == {}) is smooth
