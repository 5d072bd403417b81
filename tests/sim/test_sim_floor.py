"""A robot that hangs in its own model, set on a floor."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.robots import robot_entry
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.legged.floor import on_floor

HUNG = ("g1", "g1_23dof", "h1")


@pytest.mark.parametrize("name", HUNG)
def test_it_stands_on_its_feet(name: str) -> None:
    """The base is free; mass, joints, actuators and step are the same; the floor bears all of the weight."""
    entry = robot_entry(name)
    hung = load_model(entry.recorded_description(), 0.002)
    robot = on_floor(hung, entry.feet)
    model, data = robot.model, mujoco.MjData(robot.model)
    assert robot.base == (0, 0) and robot.coordinates[6:] == hung.coordinates
    assert robot.actuator_names == hung.actuator_names and robot.step_s == hung.step_s
    np.testing.assert_allclose(model.body_mass, hung.model.body_mass)
    pose = robot.description.default_position
    data.qpos[list(robot.qpos)] = pose
    data.ctrl[list(robot.actuator)] = np.array(pose)
    mujoco.mj_kinematics(model, data)
    feet = [model.geom(foot).id for foot in entry.feet]
    corners = [data.geom_xpos[k, 2] - np.abs(data.geom_xmat[k][6:]) @ model.geom_size[k] for k in feet]
    assert min(corners) == pytest.approx(0.0, abs=1e-9)
    for _ in range(100):
        mujoco.mj_step(model, data)
    touching = {k for contact in data.contact for k in contact.geom} - {model.geom("floor").id}
    assert touching <= set(feet) and touching
    force = np.zeros(6)
    pressed = 0.0
    for k in range(data.ncon):
        mujoco.mj_contactForce(model, data, k, force)
        pressed += force[0]
    assert pressed == pytest.approx(9.81 * model.body_mass.sum(), rel=0.2)


def test_the_robots_own_model_is_as_before() -> None:
    """It still hangs: no free joint, no contact."""
    entry = robot_entry("h1")
    hung = load_model(entry.recorded_description())
    on_floor(hung, entry.feet)
    assert hung.base is None and hung.description.floating_base is None
    assert hung.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT


def test_what_cannot_be_set_on_a_floor_is_named() -> None:
    """A foot that is none of the model's, and a robot that stands already."""
    hung = load_model(robot_entry("h1").recorded_description())
    with pytest.raises(UnknownNameError, match="left_shoe"):
        on_floor(hung, ("left_shoe",))
    walker = load_model(robot_entry("go2").recorded_description())
    with pytest.raises(ConfigurationError, match=r"'go2' has 1 bodies.*a free base.*with a fixed base"):
        on_floor(walker, ("FL_foot",))
