"""Torques of links along a motion, against a pendulum computed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.sim.engine.inverse_dynamics import link_torques
from deal_hw.testing.plain_robots import make_robot, write
from deal_hw.workflows.calibration.intake import calibration_input
from deal_hw.workflows.calibration.settings import FilesSettings


def test_a_pendulums_torque_is_its_weight_and_its_inertia(tmp_path: Path) -> None:
    """A rod of 0.25 kg and 0.3 m: its weight times 0.15 m sin q, and its inertia without the rotor's."""
    model, paths, _ = write(make_robot("pendulum", 3), tmp_path, seconds=3.0)
    work = calibration_input(FilesSettings(model=model, data=paths))
    robot = work.robot
    angle, acceleration = np.array([[0.0], [0.5], [0.5]]), np.array([[0.0], [0.0], [2.0]])
    found = link_torques(robot, angle, np.ones_like(angle), acceleration)[:, 0]
    weight = 0.25 * 9.81 * 0.15 * np.sin(0.5)
    inertia = float(robot.model.dof_M0[0] - robot.model.dof_armature[0])
    assert found == pytest.approx([0.0, weight, weight + 2.0 * inertia], rel=1e-6, abs=1e-9)
    assert robot.model.dof_armature[0] > 0
