"""Kinematic trees: which of them act on each other, and changes that one simulation can show together."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.engine.model import RobotModel, robot_model
from deal_hw.sim.engine.trees import independent_trees, reached, sharing
from deal_hw.sim.mjcf.describe import describe, sampling

ARM = """
<body name="{n}upper" pos="0 {y} 0"><joint name="{n}1" axis="0 0 1"/>
  <geom name="{n}rod" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/>
  <body name="{n}fore" pos=".3 0 0"><joint name="{n}2" axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".3"/><site name="{n}hand" pos=".3 0 0"/>
  </body>
</body>
"""
GHOSTS = '<default><geom contype="0" conaffinity="0"/></default>'
JOINTS = ("l1", "l2", "r1", "r2")
APART = np.zeros((3, 4))
CROSSED = np.array([[0.0, 0.0, 0.0, 0.0], [-0.9, 0.0, 0.9, 0.0]])
"""Two arms side by side, 0.4 m apart, and turned towards each other until the forearms cross."""


def arms(tmp_path: Path, more: str = "", body: str = "") -> mujoco.MjModel:
    """Return the compiled model of two arms on one table, with more in the MJCF."""
    text = (
        f'<mujoco><compiler angle="radian"/><worldbody>{ARM.format(n="l", y=0.2)}{ARM.format(n="r", y=-0.2)}'
        f"{body}</worldbody>{more}<actuator>"
        + "".join(f'<position name="{j}m" joint="{j}" kp="10"/>' for j in JOINTS)
        + "</actuator></mujoco>"
    )
    path = tmp_path / "arms.xml"
    path.write_text(text, encoding="utf-8")
    return mujoco.MjModel.from_xml_path(str(path))


def robot(tmp_path: Path, more: str = "", joints: tuple[str, ...] = JOINTS, body: str = "") -> RobotModel:
    """Return the same as a robot whose joints are recorded in an order."""
    model = arms(tmp_path, more, body)
    facts = describe(tmp_path / "arms.xml", model, joints, joints, sampling(0.02, 0.002, 0.4))
    return robot_model(facts, model)


def test_two_arms_are_two_trees(tmp_path: Path) -> None:
    """Also where joints are in another order than in the model."""
    assert independent_trees(robot(tmp_path), APART).tolist() == [0, 0, 1, 1]
    mixed = robot(tmp_path, joints=("r2", "l1", "r1", "l2"))
    assert independent_trees(mixed, APART).tolist() == [1, 0, 1, 0]


def test_arms_that_touch_in_a_recording_act_on_each_other(tmp_path: Path) -> None:
    """Unless the model has no such contact."""
    assert independent_trees(robot(tmp_path), CROSSED).tolist() == [0, 0, 0, 0]
    for without in (
        '<option><flag contact="disable"/></option>',
        GHOSTS,
    ):
        assert independent_trees(robot(tmp_path, without), CROSSED).tolist() == [0, 0, 1, 1]
    pair = f'{GHOSTS}<contact><pair geom1="lrod" geom2="rrod"/></contact>'
    assert independent_trees(robot(tmp_path, pair), APART).tolist() == [0, 0, 1, 1]
    bent = np.array([[-1.4, 0.0, 1.4, 0.0]])
    assert independent_trees(robot(tmp_path, pair), bent).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize(
    ("more", "body"),
    [
        ('<equality><joint joint1="l1" joint2="r1"/></equality>', ""),
        ('<equality><connect body1="lfore" body2="rfore" anchor="0 0 0"/></equality>', ""),
        ('<equality><weld site1="lhand" site2="rhand"/></equality>', ""),
        ('<tendon><fixed><joint joint="l1" coef="1"/><joint joint="r1" coef="1"/></fixed></tendon>', ""),
        ('<tendon><spatial><site site="lhand"/><site site="rhand"/></spatial></tendon>', ""),
        ("", '<body pos="1 0 0"><freejoint name="box"/><geom size=".1" mass="1"/></body>'),
    ],
)
def test_what_joins_them_makes_one_tree(tmp_path: Path, more: str, body: str) -> None:
    """A box that no recording has may be anywhere."""
    facts = robot(tmp_path).description
    made = robot_model(facts, arms(tmp_path, more, body))
    assert independent_trees(made, APART).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize(
    "more",
    [
        '<equality><joint joint1="l1" joint2="l2"/></equality>',
        '<equality><connect body1="lfore" body2="world" anchor="0 0 0"/></equality>',
        '<tendon><fixed><joint joint="r1" coef="1"/><joint joint="r2" coef="1"/></fixed></tendon>',
    ],
)
def test_what_stays_within_an_arm_joins_nothing(tmp_path: Path, more: str) -> None:
    """Nor does what holds one to the world."""
    assert independent_trees(robot(tmp_path, more), APART).tolist() == [0, 0, 1, 1]


def parameter(kind: str, *elements: str) -> Parameter:
    """Return a parameter of elements."""
    return Parameter(
        name=f"{'+'.join(elements)}.{kind}", kind=kind, elements=elements, unit="", nominal=1, low=0.5, high=2
    )


def test_a_parameter_moves_the_trees_of_its_elements(tmp_path: Path) -> None:
    """Of joints, actuators, bodies and geoms; of the floor all, and of another set-up nothing."""
    floor = '<geom name="floor" type="plane" size="1 1 .1" pos="0 0 -1"/>'
    made = robot(tmp_path, body=floor)
    space = ParameterSpace(
        [
            parameter("dof_damping", "l2"),
            parameter("servo_stiffness", "r1m"),
            parameter("body_mass", "rfore"),
            parameter("geom_friction", "lrod"),
            parameter("geom_friction", "floor"),
            parameter("dof_armature", "l1", "r1"),
            parameter("dof_frictionloss"),
        ]
    )
    left, right, every = [True, True, False, False], [False, False, True, True], [True] * 4
    expected = [left, right, right, left, every, every, [False] * 4]
    assert reached(made, space, np.array([0, 0, 1, 1])).tolist() == expected
    assert reached(made, space, np.zeros(4, dtype=np.int64)).tolist() == [every] * 6 + [[False] * 4]


@given(nps.arrays(bool, st.tuples(st.integers(0, 12), st.integers(1, 5))))
def test_no_two_changes_in_one_simulation_move_a_coordinate(reach: np.ndarray) -> None:
    """Each change has one, and as few are used as a coordinate with most changes needs at least."""
    number = sharing(reach)
    assert number.shape == (len(reach),)
    for one in range(number.max(initial=-1) + 1):
        together = reach[number == one]
        assert len(together) and together.sum(axis=0).max() <= 1
    assert number.max(initial=-1) + 1 >= reach.sum(axis=0).max(initial=0)


def test_two_arms_need_half_the_simulations() -> None:
    """Of ten parameters of one arm and eight of the other, and a latency of both, eleven remain."""
    left, right = [True, True, False, False], [False, False, True, True]
    assert sharing(np.array([left] * 10 + [right] * 8 + [[True] * 4])).max() + 1 == 11
