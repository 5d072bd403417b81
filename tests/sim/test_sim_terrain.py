"""Terrain: what an option names, its height in closed form, and robots that stand on it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from deal_hw.drivers.go2.emulator.truth import nominal_truth
from deal_hw.errors import ConfigurationError
from deal_hw.motions.velocity import FixedVelocity
from deal_hw.parameters import ParameterSpace
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import recorded_description
from deal_hw.sim.engine.batch import ServoBatch
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.legged.terrain import (
    DISTANCE_M,
    LENGTH_M,
    RAMP_M,
    BatchPlatforms,
    Terrain,
    terrain_geoms,
    with_terrain,
)
from deal_hw.workflows.emulation.virtual_go2 import walk
from deal_hw.workflows.shipped import required_policy

GO2 = recorded_description("go2")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", None),
        ("box:0.2", Terrain(kind="box", rise=0.2, distance_m=DISTANCE_M)),
        ("slope:0.15,1.5", Terrain(kind="slope", rise=0.15, distance_m=1.5)),
    ],
)
def test_an_option_names_a_terrain(text: str, expected: Terrain | None) -> None:
    """Kind, height or angle, and distance; nothing is a flat floor."""
    assert Terrain.parse(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "box",
        "box:",
        "box:high",
        "box:0",
        "box:-0.1",
        "box:0.9",
        "box:nan",
        "box:0.2,0.1",
        "box:0.2,1,2",
        "hill:1",
    ],
)
def test_other_texts_are_refused_with_what_is_allowed(text: str) -> None:
    """Each message says an example or the range."""
    with pytest.raises(ConfigurationError, match=r"box:0\.2|allowed"):
        Terrain.parse(text)


def test_the_height_is_that_of_the_compiled_surface() -> None:
    """A ray from above meets box and slope where the closed form says, off the rounded edge."""
    for terrain in (
        Terrain(kind="box", rise=0.2, distance_m=1.0),
        Terrain(kind="slope", rise=0.2, distance_m=0.8),
    ):
        model = with_terrain(load_model(GO2), terrain).model
        data = mujoco.MjData(model)
        data.qpos[2] = 50.0
        mujoco.mj_forward(model, data)
        for x in (0.6, 1.1, 1.9, 2.9, 4.9):
            hit = np.zeros(1, dtype=np.int32)
            down = mujoco.mj_ray(model, data, [x, 0.3, 10.0], [0.0, 0.0, -1.0], None, 1, -1, hit)
            assert 10.0 - down == pytest.approx(float(terrain.height(np.array(x))), abs=1e-6), (terrain, x)
    assert terrain.top_m == pytest.approx(RAMP_M * np.sin(0.2))
    assert float(terrain.height(np.array(0.8 + RAMP_M + LENGTH_M + 0.1))) == 0.0


def test_robots_of_a_batch_stand_on_platforms_of_their_own_height() -> None:
    """Three robots held in their default pose: on 0.1 m, on 0.2 m, and on the floor where there is none."""
    terrain = Terrain(kind="box", rise=0.05)
    robot = with_terrain(load_model(GO2, 0.002), terrain)
    batch = ServoBatch(robot, ParameterSpace([]), 3, threads=1)
    places = batch.batch.bind("geom_xpos")
    platforms = BatchPlatforms(batch, terrain)
    rise = np.array([0.1, 0.2, 0.0])
    platforms.place(np.arange(3), rise, np.array([1.0, 1.5, 1.0]))
    position, velocity = batch.position, np.zeros((3, 18))
    position[:, 0], position[:, 2] = 2.5, 0.29 + rise
    position[:, 6:] = GO2.default_position
    batch.set_state(position, velocity)
    batch.advance(np.broadcast_to(np.array(GO2.default_position), (3, 400, 12)))
    feet = [robot.model.geom(name).id for name in GO2.feet]
    soles = places[:, feet, 2] - robot.model.geom_size[feet, 0]
    np.testing.assert_allclose(soles, np.repeat(rise[:, None], 4, axis=1), atol=3e-3)
    np.testing.assert_allclose(platforms.height(position[:, :1])[:, 0], rise)
    assert platforms.height(np.array([[0.9], [1.4], [0.9]])).max() == 0.0


def test_without_terrain_the_model_is_as_before() -> None:
    """Legs touch terrain alone: the flat model has neither its geoms nor the legs' collision bit."""
    flat, raised = load_model(GO2).model, with_terrain(load_model(GO2), Terrain(kind="box", rise=0.1)).model
    assert terrain_geoms(flat) == [] and len(terrain_geoms(raised)) == 3
    assert flat.geom("FL_thigh").contype == 0 and raised.geom("FL_thigh").contype == 2
    floor = raised.geom("floor")
    assert not raised.geom("FL_thigh").contype & floor.conaffinity


def test_the_emulated_robot_meets_its_terrain() -> None:
    """The walking policy goes up a ramp of 0.15 rad; a platform of 0.2 m stops it, as expected."""
    policy = OnnxPolicy(required_policy("go2"))
    ahead = {}
    for text in ("slope:0.15,0.6", "box:0.2,0.6"):
        done = walk(
            nominal_truth(),
            policy,
            FixedVelocity((0.8, 0.0, 0.0)),
            2.5,
            record=False,
            terrain=Terrain.parse(text),
        )
        assert done.report.reason == "the run is over", text
        ahead[text] = float(done.track.place[:, 0].max())
    assert ahead["slope:0.15,0.6"] > 1.4
    assert ahead["box:0.2,0.6"] < 0.6
