"""Draw a policy at work in its environment: a strip of pictures, or an animation.

    MUJOCO_GL=osmesa python tools/draw_policy.py humanoid --out walk.png
    MUJOCO_GL=osmesa python tools/draw_policy.py allegro --policy FILE.onnx --out turn.gif
    MUJOCO_GL=osmesa python tools/draw_policy.py go2-climb --terrain box:0.15 --out climb.gif
    MUJOCO_GL=osmesa python tools/draw_policy.py go2-climb --terrain slope:0.2 --out slope.gif

The physics is drawn under uniform domain randomisation, as in training. Without a GPU: apt-get install
libosmesa6. The hand's cube has a red arrow along its x axis; the green arrow beside it is the target's. The
Go2 walks and canters straight ahead, at 1.0 and 1.2 m/s. It climbs at 0.6 m/s, and is told of its platform.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from deal_hw.bench.go2_tasks import STRAIGHT_M_S, climb_task
from deal_hw.policies.canter_env import CanterEnv, CanterTask
from deal_hw.policies.climb_env import ClimbEnv
from deal_hw.policies.go2_env import Go2Env, WalkTask
from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import recorded_description, training_task
from deal_hw.sim.legged.terrain import Terrain, add_terrain
from deal_hw.types import FloatArray
from deal_hw.workflows.train import udr_distribution

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
SIZE: Final = (240, 240)
"""Width and height of a picture [px]."""
ANIMATED_HZ: Final = 12.5
WALK_M_S: Final = 1.0
_BACKGROUND: Final = (0.93, 0.95, 0.96)


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A robot's policy and where it is seen from.

    Attributes:
        robot: The robot.
        task: Name of one of its further tasks; "" for its usual one.
        file: Name of its shipped policy.
        distance: From the middle of the picture to the camera [m].
        azimuth: Of the camera [degrees].
        elevation: Of the camera [degrees].
        look_at: Point in the picture's middle [m]; where the camera follows, relative to the base's place.
        follows: Whether the camera follows the base along x and y.
    """

    robot: str
    task: str = ""
    file: str
    distance: float
    azimuth: float
    elevation: float
    look_at: tuple[float, float, float]
    follows: bool


_BESIDE_GO2: Final[dict[str, Any]] = {
    "distance": 1.5,
    "azimuth": 110.0,
    "elevation": -12.0,
    "look_at": (0.0, 0.0, 0.25),
    "follows": True,
}
VIEWS: Final = {
    "allegro": View(
        robot="allegro",
        file="allegro_turn",
        distance=0.36,
        azimuth=200.0,
        elevation=-50.0,
        look_at=(0.02, 0.0, 0.065),
        follows=False,
    ),
    "ant": View(
        robot="ant",
        file="ant_udr",
        distance=3.5,
        azimuth=110.0,
        elevation=-20.0,
        look_at=(0.0, 0.0, 0.3),
        follows=True,
    ),
    "go2": View(robot="go2", file="go2_walk", **_BESIDE_GO2),
    "go2-canter": View(robot="go2", task="canter", file="go2_canter", **_BESIDE_GO2),
    "go2-climb": View(robot="go2", task="climb", file="go2_climb", **_BESIDE_GO2),
    "humanoid": View(
        robot="humanoid",
        file="humanoid_walk",
        distance=2.5,
        azimuth=110.0,
        elevation=-8.0,
        look_at=(0.0, 0.0, 0.8),
        follows=True,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """What there is to draw.

    Attributes:
        places: MuJoCo positions after each control period, (T, nq).
        target: Rotation vector of the orientation that the cube is to have, (3,) [rad]; None without one.
        terrain: The platform before a robot that climbs.
        end: How it ended.
    """

    places: FloatArray
    target: FloatArray | None = None
    terrain: Terrain | None = None
    end: str = "no fall"


def scene(path: Path, terrain: Terrain | None) -> Any:
    """Return a robot's model with light, a plain sky and tiles on the floor, which show its speed."""
    spec: Any = mujoco.MjSpec.from_file(str(path))
    if terrain is not None:
        add_terrain(spec, terrain)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    sky, square = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtTexture.mjTEXTURE_2D
    flat, checker = mujoco.mjtBuiltin.mjBUILTIN_FLAT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    spec.add_texture(
        name="sky", type=sky, builtin=flat, rgb1=_BACKGROUND, rgb2=_BACKGROUND, width=32, height=192
    )
    spec.add_texture(
        name="tiles", type=square, builtin=checker, rgb1=[0.8] * 3, rgb2=[0.65] * 3, width=128, height=128
    )
    tiles = spec.add_material(name="tiles", texrepeat=[1, 1], texuniform=True)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.material, geom.rgba = "tiles", [1, 1, 1, 1]
    for light in spec.lights:
        spec.delete(light)
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0.2, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    return spec


def add_arrows(spec: Any, target: FloatArray) -> None:
    """Mark the cube's x axis, and that of its target orientation beside it."""
    look: dict[str, Any] = {
        "contype": 0,
        "conaffinity": 0,
        "mass": 0.0,
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
    }
    top = 0.034
    spec.body("cube").add_geom(
        size=[0.003, 0, 0], fromto=[-0.025, 0, top, 0.025, 0, top], rgba=[0.9, 0, 0, 1], **look
    )
    spec.body("cube").add_geom(
        size=[0.006, 0, 0], fromto=[0.02, 0, top, 0.025, 0, top], rgba=[0.9, 0, 0, 1], **look
    )
    middle = np.array([0.02, 0.0, 0.11])
    ahead = Rotation.from_rotvec(target).apply([1.0, 0.0, 0.0])
    for size, start, end in ((0.003, -0.025, 0.025), (0.006, 0.02, 0.025)):
        ends = [*(middle + start * ahead), *(middle + end * ahead)]
        spec.worldbody.add_geom(size=[size, 0, 0], fromto=ends, rgba=[0, 0.6, 0.1, 1], **look)


def environment(view: View, terrain: Terrain) -> Any:
    """Return a robot in the environment of its task; a Go2 goes straight ahead, onto a platform [m]."""
    description, drawn = recorded_description(view.robot), udr_distribution(view.robot, view.task)
    if view.robot != "go2":
        return training_task(view.robot, view.task).make(description, drawn, 1)
    if view.task == "climb":
        task = climb_task(terrain.rise, blind=False, kind=terrain.kind)
        return ClimbEnv(description, drawn, 1, task=task)
    kind, usual, speed = Go2Env, WalkTask(), WALK_M_S
    if view.task == "canter":
        kind, usual, speed = CanterEnv, CanterTask(), STRAIGHT_M_S
    ahead = ((speed, speed), (0.0, 0.0), (0.0, 0.0))
    return kind(
        description, drawn, 1, task=dataclasses.replace(usual, command_range=ahead, standing=0.0, zeroed=0.0)
    )


def episode(view: View, policy: OnnxPolicy, seed: int, seconds: float, terrain: Terrain) -> Episode:
    """Run a policy in its environment."""
    env = environment(view, terrain)
    env.observe_for(policy.spec)
    observation, _ = env.reset(seed=seed)
    shown: dict[str, Any] = {}
    if view.robot == "allegro":
        shown["target"] = env.wanted[0].copy()
    if isinstance(env, ClimbEnv):
        at = env.terrain
        shown["terrain"] = dataclasses.replace(terrain, distance_m=float(at.distance[0]))
    states, places = env.loop.batch.engine.bind("qpos"), []
    rate_hz = env.description.control_rate_hz
    for tick in range(min(env.ticks, round(seconds * rate_hz))):
        places.append(np.array(states[0]))
        observation, _, terminated, _, _ = env.step(policy.act_batch(observation))
        if terminated[0]:
            return Episode(places=np.array(places), end=f"ended after {(tick + 1) / rate_hz:.2f} s", **shown)
    return Episode(places=np.array(places), **shown)


def frames(view: View, shown: Episode, places: FloatArray) -> Iterator[Image.Image]:
    """Yield a picture of each of these positions, (T, nq)."""
    spec = scene(Path(str(recorded_description(view.robot).mjcf)), shown.terrain)
    if shown.target is not None:
        add_arrows(spec, shown.target)
    model = spec.compile()
    data = mujoco.MjData(model)
    camera: Any = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    width, height = SIZE
    with mujoco.Renderer(model, height, width) as renderer:
        for place in places:
            data.qpos[:] = place
            mujoco.mj_forward(model, data)
            camera.lookat[:] = view.look_at
            if view.follows:
                camera.lookat[:2] += place[:2]
            renderer.update_scene(data, camera)
            yield Image.fromarray(renderer.render())


def main() -> None:
    """Draw as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", choices=sorted(VIEWS))
    parser.add_argument("--policy", type=Path, help="by default the shipped one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument(
        "--terrain",
        type=Terrain.parse,
        default="box:0.15",
        help="before go2-climb, as for `deal-hw emulate go2`; its distance is drawn",
    )
    parser.add_argument("--pictures", type=int, default=8, help="pictures of a strip")
    parser.add_argument("--out", type=Path, required=True, help="a .png strip or a .gif animation")
    args = parser.parse_args()
    view = VIEWS[args.robot]
    policy = OnnxPolicy(args.policy or ASSETS / f"{view.file}.onnx")
    shown = episode(view, policy, args.seed, args.seconds, args.terrain)
    places = shown.places
    if args.out.suffix == ".gif":
        chosen = places[:: round(50.0 / ANIMATED_HZ)]
        pictures = [p.quantize(64) for p in frames(view, shown, chosen)]
        pictures[0].save(
            args.out, save_all=True, append_images=pictures[1:], duration=1000 / ANIMATED_HZ, loop=0
        )
    else:
        chosen = places[np.linspace(0, len(places) - 1, args.pictures).astype(int)]
        strip = Image.new("RGB", (SIZE[0] * args.pictures, SIZE[1]))
        for k, picture in enumerate(frames(view, shown, chosen)):
            strip.paste(picture, (k * SIZE[0], 0))
        strip.quantize(128).save(args.out, optimize=True)
    print(f"{args.robot}: {shown.end}, base moved {places[-1][:3] - places[0][:3]}; written: {args.out}")


if __name__ == "__main__":
    main()
