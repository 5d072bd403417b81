"""The robot as line drawings: outlines of shapes whose places are worked out by hand."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from deal_hw.calib.report.charts import robot as robot_svg
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.sim.engine.compiling import compile_mjcf
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.mjcf.describe import describe, sampling
from deal_hw.types import FloatArray
from deal_hw.viz.robot_drawing import RobotDrawing, draw_robot

SHAPES = """
<mujoco>
  <compiler angle="radian"/>
  <asset><mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="post" type="cylinder" size="0.02 0.2"/>
    <body pos="0 0 0.2">
      <joint name="turn" axis="0 1 0"/>
      <geom name="link" type="capsule" size="0.02 0.1" pos="0 0 0.1"/>
      <geom name="ball" type="sphere" size="0.05" pos="0 0 0.3"/>
      <geom name="egg" type="ellipsoid" size="0.01 0.02 0.03"/>
      <geom name="wedge" type="mesh" mesh="wedge"/>
      <body pos="0 0 0.3">
        <joint name="reach" type="slide" axis="0 0 1"/>
        <geom name="hand" type="box" size="0.05 0.01 0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="turn" kp="10"/><position joint="reach" kp="10"/></actuator>
</mujoco>
"""


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    """A hinge about y that carries every sort of shape and a slide."""
    path = tmp_path / "arm.xml"
    path.write_text(SHAPES, encoding="utf-8")
    model = compile_mjcf(path)
    names = ("turn", "reach")
    return load_model(describe(path, model, names, names, sampling(0.01, 0.002, 0.4)))


def swing(columns: int) -> FloatArray:
    """Return a motion of all coordinates, (60, C)."""
    return 0.3 * np.sin(np.arange(60)[:, None] / (5 + np.arange(columns)))


def require_inside(drawing: RobotDrawing) -> None:
    """Check that all that moves lies in the picture, each outline a closed convex polygon with an area."""
    left, bottom, width, height = drawing.box
    for outlines in drawing.moving.values():
        for outline in outlines:
            points = outline.points
            assert points.shape[1] == 2 and len(points) >= 3
            assert np.all(points >= [left, bottom]) and np.all(points <= [left + width, bottom + height])
            step = np.roll(points, -1, axis=0) - points
            after = np.roll(step, -1, axis=0)
            turn = step[:, 0] * after[:, 1] - step[:, 1] * after[:, 0]
            assert np.all(turn > -1e-12) and np.any(turn > 1e-9)


def test_every_shape_of_a_hinge_and_a_slide_is_one_outline_inside_the_picture(arm: RobotModel) -> None:
    """Seen along the hinge: planes are left out, the post stands still, all else moves once for each name."""
    drawing = draw_robot(
        arm, {"real": np.array([0.0, 0.0]), "calibrated": np.array([0.1, 0.02])}, swing(2), caption="now"
    )
    assert drawing is not None and drawing.caption == "now"
    assert [o.name for o in drawing.fixed] == ["post"]
    assert set(drawing.moving) == {"real", "calibrated"}
    for outlines in drawing.moving.values():
        assert [o.name for o in outlines] == ["link", "ball", "egg", "wedge", "hand"]
    require_inside(drawing)
    # The view is along y: the ball of 0.05 m is a circle around x = 0, z = 0.5 m.
    ball = drawing.moving["real"][1].points
    np.testing.assert_allclose(np.hypot(ball[:, 0], ball[:, 1] - 0.5), 0.05, rtol=0.03)
    # Turned by 0.1 rad about y its centre is 0.3 m from the joint, in the picture to the right.
    turned = drawing.moving["calibrated"][1].points
    centre = (turned.min(axis=0) + turned.max(axis=0)) / 2
    np.testing.assert_allclose(centre, [0.3 * np.sin(0.1), 0.2 + 0.3 * np.cos(0.1)], atol=2e-3)
    # The hand's box, seen from its side, has its four corners.
    hand = drawing.moving["real"][4].points
    np.testing.assert_allclose(
        sorted(hand.tolist()), [[-0.05, 0.48], [-0.05, 0.52], [0.05, 0.48], [0.05, 0.52]]
    )


def test_a_slide_alone_is_seen_from_the_side() -> None:
    """The cart-pole whose pole hangs still: the cart moves to the right by 0.1 m."""
    robot = load_model(CARTPOLE)
    motion = np.column_stack([np.linspace(-0.1, 0.1, 30), np.zeros(30)])
    drawing = draw_robot(robot, {"real": motion[15], "nominal": motion[15] + [0.1, 0]}, motion)
    assert drawing is not None
    require_inside(drawing)
    shift = drawing.moving["nominal"][0].points - drawing.moving["real"][0].points
    np.testing.assert_allclose(shift, np.tile([0.1, 0.0], (len(shift), 1)), atol=1e-12)


def test_a_robot_with_a_free_base_moves_with_it() -> None:
    """A Go2 whose base is 0.2 m higher is drawn higher, and turned where its orientation is."""
    robot = load_model(GO2)
    C = len(robot.coordinates)
    upright = np.array([1.0, 0, 0, 0])
    low, high = np.zeros(C), np.zeros(C)
    low[2], high[2] = 0.3, 0.5
    motion = swing(C) * np.eye(C)[[6, 7, 8]].sum(axis=0) + low
    drawing = draw_robot(robot, {"real": low, "calibrated": high}, motion, np.tile(upright, (61, 1)))
    assert drawing is not None
    require_inside(drawing)
    up = [np.concatenate([o.points for o in some])[:, 1].max() for some in drawing.moving.values()]
    assert 0.15 < up[1] - up[0] <= 0.2 + 1e-9


def test_what_diverged_and_what_has_no_shape_is_not_drawn(arm: RobotModel, tmp_path: Path) -> None:
    """A prediction that is not finite is left out; a robot without visible shapes has no drawing."""
    drawing = draw_robot(arm, {"real": np.zeros(2), "nominal": np.full(2, np.nan)}, swing(2))
    assert drawing is not None and list(drawing.moving) == ["real"]
    path = tmp_path / "bare.xml"
    bare = re.sub(r'<geom name="(?!floor|post)', r'<geom group="4" mass="1" name="', SHAPES)
    path.write_text(bare, encoding="utf-8")
    names = ("turn", "reach")
    robot = load_model(describe(path, compile_mjcf(path), names, names, sampling(0.01, 0.002, 0.4)))
    assert draw_robot(robot, {"real": np.zeros(2)}, swing(2)) is None


def test_the_svg_has_one_closed_path_a_shape(arm: RobotModel) -> None:
    """Six shapes of the real robot, five of which move and are there twice, and a bar of a round length."""
    drawing = draw_robot(arm, {"real": np.zeros(2), "nominal": np.ones(2) / 9}, swing(2), caption="<here>")
    assert drawing is not None
    svg = robot_svg(drawing)
    assert len(re.findall(r'd="M[^"]+Z"', svg)) == 1 + 2 * 5
    assert svg.count('class="body real"') == svg.count('class="body nominal"') == 5
    assert "&lt;here&gt;" in svg and "0.1 m" in svg
    width, height = map(float, re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)[0])
    for d in re.findall(r'class="body [^"]+" d="M([^"]+)Z"', svg):
        points = np.array([[float(v) for v in pair.split()] for pair in d.split("L")])
        assert np.all(points >= 0) and np.all(points <= [width, height])
