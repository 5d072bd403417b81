"""Shapes and poses of a model, against numbers worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.sim.engine.model import RobotModel, load_model
from deal_hw.sim.engine.scene import body_poses, read_scene

EXTRA_GEOMS = """
    <geom name="ball" type="sphere" size="0.02" mass="0"/>
    <geom name="egg" type="ellipsoid" size="0.01 0.02 0.03" pos="0 0 0.1" mass="0"/>
    <geom name="tube" type="cylinder" size="0.01 0.05" mass="0" rgba="1 0 0 0.5"/>
    <geom name="wedge" type="mesh" mesh="wedge" mass="0"/>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="hull" type="box" size="0.1 0.1 0.1" group="3" mass="0"/>
    <geom name="unseen" type="box" size="0.1 0.1 0.1" rgba="0 0 0 0" mass="0"/>
    <body name="cart">"""
MESH = '<asset><mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/></asset><worldbody>'


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    """The cart-pole."""
    return load_model(DESCRIPTION)


def test_cartpole_is_drawn_from_its_model(robot: RobotModel) -> None:
    """Every shape is there with its body and its size."""
    scene = read_scene(robot)
    assert scene.bodies == ("world", "cart", "pole")
    shapes = {(shape.name, scene.bodies[shape.body], shape.kind) for shape in scene.shapes}
    assert shapes == {
        ("rail", "world", "capsule"),
        ("stop_left", "world", "box"),
        ("stop_right", "world", "box"),
        ("cart", "cart", "box"),
        ("pole", "pole", "capsule"),
    }
    pole = next(shape for shape in scene.shapes if shape.name == "pole")
    np.testing.assert_allclose(pole.size[:2], [0.006, 0.15])
    np.testing.assert_allclose(pole.position, [0, 0, 0.15])


def test_bodies_follow_the_joints(robot: RobotModel) -> None:
    """At x = 0.1 m and a quarter turn the pole's body stands at the cart, turned about +y; NaN stays NaN."""
    where, turned = body_poses(robot, np.array([[0.1, math.pi / 2], [np.nan, 0.0]]))
    np.testing.assert_allclose(where[0, 1:], [[0.1, 0, 0], [0.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(turned[0, 1], [1, 0, 0, 0], atol=1e-12)
    half = math.sqrt(0.5)  # cos and sin of half a quarter turn
    np.testing.assert_allclose(turned[0, 2], [half, 0, half, 0], atol=1e-12)
    assert np.isnan(where[1]).all() and np.isnan(turned[1]).all()


def test_all_drawable_kinds_are_read(tmp_path: Path) -> None:
    """Planes, collision groups and invisible shapes stay away; all other kinds come along."""
    xml = DESCRIPTION.mjcf.read_text(encoding="utf-8")
    file = tmp_path / "robot.xml"
    file.write_text(
        xml.replace("<worldbody>", MESH).replace('<body name="cart">', EXTRA_GEOMS), encoding="utf-8"
    )
    scene = read_scene(load_model(dataclasses.replace(DESCRIPTION, mjcf=file)))
    found = {shape.name: shape for shape in scene.shapes}
    assert {found[name].kind for name in ("ball", "egg", "tube", "wedge")} == {
        "sphere",
        "ellipsoid",
        "cylinder",
        "mesh",
    }
    assert not {"floor", "hull", "unseen"} & set(found)
    np.testing.assert_allclose(found["egg"].size, [0.01, 0.02, 0.03])
    np.testing.assert_allclose(found["tube"].color, [1, 0, 0, 0.5])
    assert found["wedge"].vertices.shape == (4, 3) and found["wedge"].faces.shape == (4, 3)
    assert found["ball"].vertices.shape == (0, 3)
