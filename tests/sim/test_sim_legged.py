"""A simulated robot with legs: what it senses, and what pushes and resists do to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.errors import UnknownNameError
from deal_hw.sim.legged.simulation import LeggedSimulation

STEP_S = 0.001
HOPPER = """
<mujoco>
  <option gravity="0 0 -10"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.1"/>
    <body name="base" pos="0 0 1">
      {joint}
      <geom name="trunk" type="box" size="0.1 0.1 0.1" mass="4" contype="0" conaffinity="0"/>
      <body name="leg">
        <joint name="knee" axis="0 1 0" armature="1"/>
        <geom name="foot" type="sphere" size="0.05" pos="0 0 -0.5" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="knee" kp="100"/></actuator>
</mujoco>
"""


def hopper(folder: Path, joint: str = '<freejoint name="base"/>') -> LeggedSimulation:
    """Return a trunk on one leg, free or held."""
    path = folder / "hopper.xml"
    path.write_text(HOPPER.format(joint=joint))
    return LeggedSimulation(path, ["knee"], ["foot"], STEP_S)


def test_in_free_fall_nothing_is_felt(tmp_path: Path) -> None:
    """A falling accelerometer reads 0; after 0.1 s at 10 m/s² the speed is 1 m/s."""
    sim = hopper(tmp_path)
    for _ in range(100):
        sim.step(np.zeros(1))
    assert np.allclose(sim.specific_force(), 0.0, atol=1e-9)
    assert np.allclose(sim.base_velocity(), (0.0, 0.0, -1.0), atol=1e-9)
    assert sim.free


def test_a_held_base_feels_gravity_and_does_not_move(tmp_path: Path) -> None:
    """Without a free joint the base stays, upright, and its accelerometer reads 10 upwards."""
    sim = hopper(tmp_path, joint="")
    sim.push((50.0, 0.0, 0.0))
    for _ in range(10):
        sim.step(np.ones(1))
    assert not sim.free
    assert sim.specific_force().tolist() == [0.0, 0.0, 10.0]
    assert sim.base_position().tolist() == [0.0, 0.0, 1.0]
    assert sim.orientation().tolist() == [1.0, 0.0, 0.0, 0.0]
    assert not sim.base_velocity().any()
    assert not sim.angular_velocity().any()


def test_an_effort_accelerates_what_it_must(tmp_path: Path) -> None:
    """2 N·m on armature 1 and foot 1 * (0.5² + 0.4 * 0.05²) = 0.251: 2 / 1.251 rad/s², no actuator."""
    sim = hopper(tmp_path, joint="")
    sim.step(np.array([2.0]))
    assert sim.acceleration()[0] == pytest.approx(2.0 / 1.251, rel=1e-6)
    assert sim.velocity()[0] == pytest.approx(STEP_S * 2.0 / 1.251, rel=1e-6)


def test_the_foot_bears_the_robot(tmp_path: Path) -> None:
    """Standing still on its foot, 5 kg press with 50 N; the foot is half a metre below the base."""
    sim = hopper(tmp_path)
    sim.set_dofs(damping=np.array([1000.0]))
    sim.set_pose(np.zeros(1), 0.55)
    for _ in range(60):
        sim.step(np.zeros(1))
    assert sim.foot_force() == pytest.approx([50.0], rel=0.05)
    assert np.allclose(sim.foot_position(), [[0.0, 0.0, -0.5]], atol=1e-3)
    assert sim.specific_force()[2] == pytest.approx(10.0, abs=0.5)


def test_friction_holds_and_a_push_moves(tmp_path: Path) -> None:
    """Frictionloss above the effort keeps the joint; 10 N on 5 kg for 0.1 s make 0.2 m/s."""
    sim = hopper(tmp_path)
    sim.set_dofs(frictionloss=np.array([3.0]), armature=np.array([0.5]))
    sim.push((10.0, 0.0, 0.0))
    for _ in range(100):
        sim.step(np.array([0.0]))
    # The friction holds the leg against the base's rotation: both move as one body of 5 kg.
    centre = sim.base_velocity()[0] + np.cross(sim.angular_velocity(), (0.0, 0.0, -0.1))[0]
    assert centre == pytest.approx(0.2, rel=0.01)
    assert abs(sim.velocity()[0]) < 0.02
    sim.set_frictionloss(np.zeros(1))
    sim.push((0.0, 0.0, 0.0))
    for _ in range(20):
        sim.step(np.array([2.0]))
    assert sim.velocity()[0] > 0.02


def test_an_unknown_joint_is_named(tmp_path: Path) -> None:
    """A joint that the model lacks is an error that lists the model's."""
    path = tmp_path / "hopper.xml"
    path.write_text(HOPPER.format(joint=""))
    with pytest.raises(UnknownNameError, match="unknown MuJoCo joint 'hip'; known: knee"):
        LeggedSimulation(path, ["hip"], ["foot"], STEP_S)
