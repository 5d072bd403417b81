"""Joints that stay where they are: the file without them moves as the file with them, held there."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import deal_hw
from deal_hw.errors import ConfigurationError, UnknownNameError
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.sim.mjcf.locking import lock_joints

GRIPPER = """
<mujoco model="gripper">
  <compiler angle="degree" eulerseq="zyx" meshdir="parts"/>
  <default>
    <default class="finger"><joint type="slide" axis="0 1 0" range="0 .04" damping="10"/></default>
  </default>
  <asset><mesh name="tip" file="tip.obj"/></asset>
  <worldbody>
    <frame pos="0 0 1" euler="0 0 20">
      <body name="arm" pos="0 .1 0">
        <joint name="shoulder" axis="0 0 1" damping="1"/>
        <geom size=".1"/>
        <body name="wrist" pos="0 0 .2" euler="30 10 5">
          <joint name="roll" axis="1 .5 0" pos="0 .02 .03" ref="20"/>
          <joint name="bend" axis="0 1 0" pos="0 0 -.01"/>
          <geom size=".05" pos=".03 0 0"/>
          <frame euler="40 0 0">
            <body name="left" pos="0 .01 .05">
              <joint name="left" class="finger"/>
              <geom type="mesh" mesh="tip"/>
            </body>
          </frame>
          <body name="right" pos="0 -.01 .05" quat="0 0 0 1">
            <joint name="right" class="finger"/>
            <geom size=".01" pos="0 .01 .02"/>
          </body>
        </body>
      </body>
    </frame>
  </worldbody>
  <tendon>
    <fixed name="split"><joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed>
  </tendon>
  <equality><joint joint1="left" joint2="right"/></equality>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="10"/>
    <general name="grip" tendon="split" gainprm=".01" biastype="affine" biasprm="0 -100 -10"/>
    <position name="roll" joint="roll" kp="10"/>
    <position name="bend" joint="bend" kp="10"/>
  </actuator>
  <sensor>
    <jointpos joint="left"/><tendonpos tendon="split"/><actuatorfrc actuator="grip"/><jointpos joint="bend"/>
  </sensor>
  <keyframe><key name="home" qpos="0 .2 .1 .04 .04" ctrl="1 255 2 3"/></keyframe>
</mujoco>
"""
TIP = "v 0 0 0\nv .02 0 0\nv 0 .02 0\nv 0 0 .02\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def gripper(tmp_path: Path) -> Path:
    """The model's file, with its mesh."""
    folder = tmp_path / "robot"
    (folder / "parts").mkdir(parents=True)
    (folder / "parts" / "tip.obj").write_text(TIP, encoding="utf-8")
    (folder / "gripper.xml").write_text(GRIPPER, encoding="utf-8")
    return folder / "gripper.xml"


def poses(path: Path, at: dict[str, float]) -> dict[str, np.ndarray]:
    """Return position, orientation and mass of each body, by its name, with joints at values."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for name, value in at.items():
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    return {
        model.body(b).name: np.concatenate([data.xpos[b], data.xmat[b], model.body_mass[[b]]])
        for b in range(model.nbody)
    }


@pytest.mark.parametrize(
    ("locked", "free"),
    [
        ({"left": 0.03, "right": 0.01}, {"shoulder": 0.5, "roll": -0.3, "bend": 0.7}),
        ({"roll": 0.9}, {"shoulder": -0.4, "bend": 0.7, "left": 0.02, "right": 0.02}),
        ({"shoulder": 0.2, "roll": -1.0, "bend": 0.4}, {"left": 0.02, "right": 0.03}),
    ],
)
def test_bodies_are_where_they_were(gripper: Path, locked: dict[str, float], free: dict[str, float]) -> None:
    """Slides and hinges, in frames, with an anchor, a reference and another joint of the body behind them.

    MuJoCo writes six digits.
    """
    out = gripper.parent.parent / "elsewhere.xml"
    found = lock_joints(gripper, locked, out)
    out.write_text(found.xml, encoding="utf-8")
    before, after = poses(gripper, {**locked, **free}), poses(out, free)
    assert before.keys() == after.keys()
    for name, pose in before.items():
        np.testing.assert_allclose(after[name], pose, atol=3e-6)


def test_what_moves_only_them_goes_with_them(gripper: Path) -> None:
    """Tendon, equality, actuator and sensors; key frames keep the other joints' numbers."""
    found = deal_hw.lock_joints(gripper, joints=["left=0.04", "right=0.04"])
    assert found.path == gripper.with_name("gripper_locked.xml")
    assert set(found.removed) == {
        "tendon 'split'",
        "an unnamed equality",
        "actuator 'grip'",
        "an unnamed sensor",
    }
    model = mujoco.MjModel.from_xml_path(str(found.path))
    assert (model.njnt, model.nu, model.ntendon, model.neq, model.nsensor) == (3, 3, 0, 0, 1)
    np.testing.assert_allclose(model.key_qpos, [[0, 0.2, 0.1]])
    np.testing.assert_allclose(model.key_ctrl, [[1, 2, 3]])
    # What a calibration refuses before.
    rates = sampling(0.02, 0.002, 0.4)
    joints = ("shoulder", "roll", "bend")
    with pytest.raises(ConfigurationError, match=r"left, right.*deal-hw robot lock"):
        whole = mujoco.MjModel.from_xml_path(str(gripper))
        describe(gripper, whole, joints, joints, rates)
    assert describe(found.path, model, joints, joints, rates).actuated == joints


def test_in_the_pose_of_the_file(gripper: Path) -> None:
    """Without values; a joint behind a free one can stay nowhere else."""
    found = deal_hw.lock_joints(gripper, joints=["bend"], out=gripper.with_name("stiff.xml"))
    before, after = poses(gripper, {"roll": 0.5}), poses(found.path, {"roll": 0.5})
    for name, pose in before.items():
        np.testing.assert_allclose(after[name], pose, atol=3e-6)
    with pytest.raises(ConfigurationError, match=r"'bend' follows a free joint.*without a value"):
        deal_hw.lock_joints(gripper, joints=["bend=0.1"], out=gripper.with_name("other.xml"))


@pytest.mark.parametrize(
    ("joints", "said"),
    [
        (["left=0.01"], r"tendon 'split' joins left with right; lock all of them, or none"),
        (["left=0.05", "right"], r"'left' cannot stay at 0\.05: its range is 0 to 0\.04"),
        (["left=x"], r"'left=x': give NAME or NAME=VALUE"),
        (["left=nan"], r"give NAME or NAME=VALUE"),
        (["left", "left=0"], r"'left' is named twice"),
        ([], r"name at least one joint"),
    ],
)
def test_what_cannot_be_locked(gripper: Path, joints: list[str], said: str) -> None:
    """One line with what to do; no file is written."""
    with pytest.raises(ConfigurationError, match=said):
        deal_hw.lock_joints(gripper, joints=joints)
    assert not gripper.with_name("gripper_locked.xml").exists()


def test_an_unknown_joint_and_a_file_that_exists(gripper: Path) -> None:
    """The joints that there are; nothing is overwritten."""
    with pytest.raises(UnknownNameError, match="shoulder"):
        deal_hw.lock_joints(gripper, joints=["lefty"])
    gripper.with_name("gripper_locked.xml").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="exists; name another file"):
        deal_hw.lock_joints(gripper, joints=["bend"])


def test_a_free_joint_does_not_lock(tmp_path: Path) -> None:
    """Nor does a ball."""
    path = tmp_path / "ball.xml"
    body = '<body><joint name="ball" type="ball"/><geom size=".1"/></body>'
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="only hinges and slides lock"):
        deal_hw.lock_joints(path, joints=["ball"])
