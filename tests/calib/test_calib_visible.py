"""What no rollout sees is refused before any search; held-out errors in physical units."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from deal_hw.calib.heldout import heldout_rmse
from deal_hw.calib.problem import Problem
from deal_hw.calib.visible import look, require_visible
from deal_hw.errors import ConfigurationError
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.describe import compile_model, describe, sampling
from deal_hw.sim.episode import Episode
from deal_hw.sim.model import RobotModel, load_model

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
    return load_model(describe(path, compile_model(path), ("rail",), ("rail",), rates), rates.step_s)


def steps_of(robot: RobotModel, T: int = 200) -> Episode:
    """Return an episode at rest in which the command steps by 5 cm; the positions are all zero."""
    steps = 5 * (T - 1)
    rows = np.ones((steps, 1))
    square = 0.05 * np.sign(np.sin(2 * np.pi * np.arange(steps) / 250))[:, None]
    return Episode(
        step_s=robot.step_s, sample=5 * np.arange(T), position=np.zeros((T, 1)), velocity=np.zeros((T, 1)),
        target=square, stiffness=50 * rows, damping=rows, effort_limit=100 * rows, speed_limit=rows * np.inf,
        usable=np.ones(T, dtype=bool), start_setpoint=np.zeros(1),
    )  # fmt: skip


def test_parameters_are_told_apart_by_what_they_change(robot: RobotModel) -> None:
    """The gain is seen, a friction of 1e-6 N hardly, a force limit that is never reached not at all."""
    space = ParameterSpace(
        [
            Parameter.around("gain", "servo_stiffness", ("drive",), "N/m", 50.0),
            Parameter.around("friction", "dof_frictionloss", ("rail",), "N", 1e-6),
            Parameter(name="limit", kind="servo_effort_limit", elements=("drive",), unit="N", nominal=100.0,
                      low=50.0, high=200.0),
        ]
    )  # fmt: skip
    found = look(Problem(robot, space, [steps_of(robot)], threads=1, known_std=STD))
    assert found.invisible == ("limit",) and found.faint == ("friction",)
    assert found.effect[0] > 10
    with pytest.raises(ConfigurationError, match="sees limit"):
        require_visible(found)


def test_heldout_errors_are_in_metres(robot: RobotModel) -> None:
    """At rest a prediction that never moves is right; one that follows the command is off by less than it."""
    space = ParameterSpace([Parameter.around("gain", "servo_stiffness", ("drive",), "N/m", 50.0, ratio=1e9)])
    candidates = {"model": (np.array([50.0]), 0.0), "slack": (np.array([1e-7]), 0.0)}
    found = heldout_rmse(robot, space, [steps_of(robot)], candidates, window_s=0.5, threads=1)
    assert found.names == ("rail",) and set(found.rmse) == {"model", "slack", "null"}
    assert found.mean()["null"] == 0.0 and found.mean()["slack"] == pytest.approx(0.0, abs=1e-8)
    assert 0.01 < found.mean()["model"] < 0.1
    assert found.mean()["model"] == pytest.approx(found.pooled()["model"])
    assert found.to_json()["by_coordinate"]["model"]["rail"] == pytest.approx(found.rmse["model"][0])
    assert not math.isnan(found.window_s)
