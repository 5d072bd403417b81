"""Places of a robot's parts."""

from __future__ import annotations

import numpy as np

from deal_hw.drivers.so101.description import DRIVEN
from deal_hw.sim.engine.kinematics import point_positions
from deal_hw.sim.engine.model import load_model


def test_turning_the_base_turns_the_tip_about_the_vertical() -> None:
    """The tip keeps its height and its distance from the axis, and turns by the joint's angle."""
    joints = np.zeros((2, 6))
    joints[1, 0] = 0.5
    before, after = point_positions(load_model(DRIVEN), "gripper", (0.0, 0.0, -0.09), joints)
    # The axis of shoulder_pan stands at this place of the model, and points down.
    axis = np.array([0.0388353, 0.0])
    turn = np.array([[np.cos(-0.5), -np.sin(-0.5)], [np.sin(-0.5), np.cos(-0.5)]])
    np.testing.assert_allclose(after[2], before[2], atol=1e-12)
    np.testing.assert_allclose(after[:2] - axis, turn @ (before[:2] - axis), atol=1e-9)
    assert np.linalg.norm(before[:2] - axis) > 0.2
