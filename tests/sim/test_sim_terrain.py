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
    STEPS,
    TREAD_M,
    BatchTerrain,
    Kind,
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
        ("steps:0.1", Terrain(kind="steps", rise=0.1, distance_m=DISTANCE_M)),
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
        "steps:0.3",
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
    """A ray from above meets each terrain where the closed form says, off the rounded edges."""
    for terrain in (
        Terrain(kind="box", rise=0.2, distance_m=1.0),
        Terrain(kind="steps", rise=0.2, distance_m=1.0),
        Terrain(kind="slope", rise=0.2, distance_m=0.8),
    ):
        model = with_terrain(load_model(GO2), terrain).model
        data = mujoco.MjData(model)
        data.qpos[2] = 50.0
        mujoco.mj_forward(model, data)
        for x in (0.6, 1.1, 1.4, 1.9, 2.9, 4.9):
            hit = np.zeros(1, dtype=np.int32)
            down = mujoco.mj_ray(model, data, [x, 0.3, 10.0], [0.0, 0.0, -1.0], None, 1, -1, hit)
            assert 10.0 - down == pytest.approx(float(terrain.height(np.array(x))), abs=1e-6), (terrain, x)
    assert terrain.top_m == pytest.approx(RAMP_M * np.sin(0.2))
    assert float(terrain.height(np.array(0.8 + RAMP_M + LENGTH_M + 0.1))) == 0.0


def test_steps_rise_one_after_the_other() -> None:
    """By hand: three steps of 0.1 m and 0.3 m depth from 1 m on, the last of which is the platform."""
    steps = Terrain(kind="steps", rise=0.1)
    assert (STEPS, TREAD_M) == (3, 0.3) and steps.top_m == pytest.approx(0.3)
    np.testing.assert_allclose(
        steps.height(np.array([0.99, 1.0, 1.29, 1.31, 1.61, 4.9, 5.1])), [0, 0.1, 0.1, 0.2, 0.3, 0.3, 0]
    )


@pytest.mark.parametrize("kinds", [("box",), ("steps",), ("slope",), ("box", "steps", "slope")])
def test_robots_of_a_batch_stand_on_terrain_of_their_own(kinds: tuple[Kind, ...]) -> None:
    """Robots held in their default pose, two on each kind's platform, and one where there is none."""
    robot = with_terrain(load_model(GO2, 0.002), *(Terrain(kind=kind, rise=0.05) for kind in kinds))
    count = 2 * len(kinds) + 1
    batch = ServoBatch(robot, ParameterSpace([]), count, threads=1)
    places = batch.batch.bind("geom_xpos")
    terrain = BatchTerrain(batch, kinds)
    kind = np.append(np.repeat(np.arange(len(kinds)), 2), 0)
    rise = np.append(np.tile([0.1, 0.2], len(kinds)), 0.0)
    distance = np.append(np.tile([0.5, 0.7], len(kinds)), 0.5)
    terrain.place(np.arange(count), rise, distance, kind)
    top = terrain.top()
    expected = {"box": rise, "steps": STEPS * rise, "slope": RAMP_M * np.sin(rise)}
    np.testing.assert_allclose(top, [expected[kinds[k]][n] for n, k in enumerate(kind)])
    position, velocity = batch.position, np.zeros((count, 18))
    position[:, 0], position[:, 2] = 3.5, 0.29 + top
    position[:, 6:] = GO2.default_position
    batch.set_state(position, velocity)
    batch.advance(np.broadcast_to(np.array(GO2.default_position), (count, 400, 12)))
    feet = [robot.model.geom(name).id for name in GO2.feet]
    soles = places[:, feet, 2] - robot.model.geom_size[feet, 0]
    np.testing.assert_allclose(soles, np.repeat(top[:, None], 4, axis=1), atol=3e-3)
    np.testing.assert_allclose(terrain.height(position[:, :1])[:, 0], top)
    assert (terrain.top_begins() < 3.1).all() and not terrain.height(np.full((count, 1), 0.45)).any()


def test_a_robot_of_a_batch_stands_on_its_own_slope() -> None:
    """Two robots on ramps of other angles than the compiled one: each stands where the closed form says."""
    robot = with_terrain(load_model(GO2, 0.002), Terrain(kind="slope", rise=0.05))
    batch = ServoBatch(robot, ParameterSpace([]), 2, threads=1)
    places, terrain = batch.batch.bind("geom_xpos"), BatchTerrain(batch, ("slope",))
    # Constants are derived while no member has a slope, as when a training begins.
    batch.engine.set_const()
    angle = np.array([0.1, 0.2])
    terrain.place(np.arange(2), angle, np.array([0.5, 0.6]))
    position = batch.position
    position[:, 0], position[:, 2] = 1.4, 0.3 + terrain.height(np.full((2, 1), 1.4))[:, 0]
    position[:, 4] = -angle
    position[:, 6:] = GO2.default_position
    batch.set_state(position, np.zeros((2, 18)))
    batch.advance(np.broadcast_to(np.array(GO2.default_position), (2, 400, 12)))
    feet = [robot.model.geom(name).id for name in GO2.feet]
    # A round foot touches a slope beside its lowest point.
    radius = robot.model.geom_size[feet, 0] / np.cos(angle)[:, None]
    soles = places[:, feet, 2] - radius
    np.testing.assert_allclose(soles, terrain.height(places[:, feet, 0]), atol=3e-3)


def test_edges_ahead_and_near() -> None:
    """By hand: the way to the next edge, and the distance from the nearest one; a slope has none."""
    robot = with_terrain(
        load_model(GO2, 0.002), Terrain(kind="steps", rise=0.1), Terrain(kind="slope", rise=0.1)
    )
    terrain = BatchTerrain(ServoBatch(robot, ParameterSpace([]), 2, threads=1), ("steps", "slope"))
    terrain.place(np.arange(2), np.array([0.1, 0.1]), np.array([1.0, 1.0]), np.array([0, 1]))
    x = np.array([[0.8, 1.1, 1.5, 1.7]] * 2)
    np.testing.assert_allclose(terrain.to_edge(x), [[0.2, 0.2, 0.1, np.inf], [np.inf] * 4])
    np.testing.assert_allclose(terrain.from_edge(x), [[0.2, 0.1, 0.1, 0.1], [np.inf] * 4])


def test_without_terrain_the_model_is_as_before() -> None:
    """Legs touch terrain alone: the flat model has neither its geoms nor the legs' collision bit."""
    flat, raised = load_model(GO2).model, with_terrain(load_model(GO2), Terrain(kind="box", rise=0.1)).model
    assert terrain_geoms(flat) == [] and len(terrain_geoms(raised)) == 3
    assert flat.geom("FL_thigh").contype == 0 and raised.geom("FL_thigh").contype == 2
    floor = raised.geom("floor")
    assert not raised.geom("FL_thigh").contype & floor.conaffinity


@pytest.mark.slow
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
